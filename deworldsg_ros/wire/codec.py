"""Conversion between the graphs of a frame and their messages, without loss."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from msgspec import UNSET, UnsetType

from deworldsg_ros.scene.arrays import Float16, Float32, Float64, UInt8, UInt16
from deworldsg_ros.scene.camera import Intrinsics
from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.frame_graph import (
    GRID,
    DepthGrid,
    Embeddings,
    FrameGraph,
    LocalGraph,
    RelationEvidence,
    Relations,
    Vocabulary,
)
from deworldsg_ros.scene.limits import MAX_PREDICTION_SUM_ERROR, MAX_PREDICTIONS, check_labels
from deworldsg_ros.wire import messages as wire


def _relations_to_wire(relations: Relations) -> list[wire.RelationLogits]:
    return [
        wire.RelationLogits(int(subject), int(object_), float(score), logits.tolist())
        for (subject, object_), score, logits in zip(
            relations.pairs, relations.scores, relations.logits
        )
    ]


def _relations_from_wire(items: list[wire.RelationLogits], predicate_count: int) -> Relations:
    if not items:
        return Relations.none(predicate_count)
    return Relations(
        pairs=np.array([[item.subject, item.object] for item in items], np.int64),
        logits=_rows([item.logits for item in items], predicate_count, "relation logits"),
        scores=np.array([item.score for item in items], np.float64),
    )


def _predictions(pairs: list[wire.PairEvidence], predicate_count: int) -> Float64:
    """Predictions (m, R); rows of NaN for pairs without one."""
    if len(pairs) * predicate_count > MAX_PREDICTIONS:
        raise ValueError(
            f"{len(pairs)} pairs with {predicate_count} predicates: expected at most "
            f"{MAX_PREDICTIONS} predictions"
        )
    nothing = [float("nan")] * predicate_count
    predictions = _rows(
        [item.prediction or nothing for item in pairs], predicate_count, "prediction"
    )
    sums = predictions.sum(axis=1)
    if (np.abs(sums - 1.0) > MAX_PREDICTION_SUM_ERROR).any():
        row = int(np.nanargmax(np.abs(sums - 1.0)))
        raise RefusedInput(
            "invalid_prediction",
            f"prediction of row {row} sums to {sums[row]:.6g}: expected 1",
        )
    return predictions


def _rows(rows: list[list[float]], width: int, name: str) -> Float64:
    for index, row in enumerate(rows):
        if len(row) != width:
            raise ValueError(f"{name} of row {index} have {len(row)} values: expected {width}")
    return np.array(rows, np.float64).reshape(len(rows), width)


def _colours_to_wire(colours_lab: Float32 | None, count: int) -> list[list[float] | UnsetType]:
    if colours_lab is None:
        return [UNSET] * count
    return [row if row[0] == row[0] else UNSET for row in colours_lab.tolist()]  # NaN differs


def _colours_from_wire(items: Sequence[wire.DetectedObject | wire.LiftedObject]) -> Float32 | None:
    """Colours (n, 3), a row of NaN where there is none; None if no object has one."""
    if all(item.colour_lab is UNSET for item in items):
        return None
    nothing = [float("nan")] * 3
    rows = [nothing if item.colour_lab is UNSET else item.colour_lab for item in items]
    return np.array(rows, np.float32)


def _embeddings_to_wire(embeddings: Embeddings | None, count: int) -> list[bytes | UnsetType]:
    found: list[bytes | UnsetType] = [UNSET] * count
    if embeddings is not None:
        for row, vector in zip(embeddings.rows.tolist(), embeddings.vectors):
            found[row] = vector.astype("<f2").tobytes()
    return found


def _embeddings_from_wire(
    items: Sequence[wire.DetectedObject | wire.LiftedObject], model: str | UnsetType
) -> Embeddings | None:
    known = [(row, item.embedding) for row, item in enumerate(items) if item.embedding is not UNSET]
    if not known:
        return None
    rows = np.array([row for row, _ in known], np.int64)
    vectors = vectors_from_bytes([content for _, content in known])
    return Embeddings(rows, vectors, "" if model is UNSET else model)


def vectors_from_bytes(contents: Sequence[bytes]) -> Float16:
    """Vectors (n, D) of one length; ValueError if their lengths differ."""
    sizes = sorted({len(content) for content in contents})
    if len(sizes) > 1 or sizes[0] % 2:
        raise ValueError(f"embeddings of {sizes} bytes: expected one even number")
    flat = np.frombuffer(b"".join(contents), "<f2")
    return flat.reshape(len(contents), -1).astype(np.float16)


@lru_cache(maxsize=4)
def _vocabulary(classes: tuple[str, ...], predicates: tuple[str, ...]) -> Vocabulary:
    """The vocabulary, checked once: every message of a session repeats it."""
    check_labels(classes)
    check_labels(predicates)
    return Vocabulary(classes, predicates)


def frame_graph_to_message(graph: FrameGraph) -> wire.FrameGraphMessage:
    """The message of a 2D scene graph."""
    colours = _colours_to_wire(graph.colours_lab, len(graph))
    embeddings = _embeddings_to_wire(graph.embeddings, len(graph))
    return wire.FrameGraphMessage(
        schema=wire.schema_of(wire.FrameGraphMessage),
        stamp=wire.stamp_from_ns(graph.stamp_ns),
        frame_id=graph.frame_id,
        width=graph.width,
        height=graph.height,
        classes=list(graph.vocabulary.classes),
        predicates=list(graph.vocabulary.predicates),
        objects=[
            wire.DetectedObject(
                graph.boxes_xyxy[row].tolist(),
                float(graph.scores[row]),
                graph.class_probabilities[row].tolist(),
                colours[row],
                embeddings[row],
            )
            for row in range(len(graph))
        ],
        relations=_relations_to_wire(graph.relations),
        embedding_model=UNSET if graph.embeddings is None else graph.embeddings.model,
        rgb_grid=b"" if graph.rgb_grid is None else graph.rgb_grid.tobytes(),
    )


def frame_graph_from_message(message: wire.FrameGraphMessage) -> FrameGraph:
    """The 2D scene graph of a message; ``invalid_message`` if its parts do not fit."""
    objects = message.objects
    try:
        return FrameGraph(
            stamp_ns=wire.ns_from_stamp(message.stamp),
            frame_id=message.frame_id,
            width=message.width,
            height=message.height,
            vocabulary=_vocabulary(tuple(message.classes), tuple(message.predicates)),
            boxes_xyxy=_rows([item.box_xyxy for item in objects], 4, "box"),
            class_probabilities=_rows(
                [item.class_probabilities for item in objects],
                len(message.classes),
                "class probabilities",
            ),
            scores=np.array([item.score for item in objects], np.float64),
            relations=_relations_from_wire(message.relations, len(message.predicates)),
            colours_lab=_colours_from_wire(objects),
            embeddings=_embeddings_from_wire(objects, message.embedding_model),
            rgb_grid=_rgb(message.rgb_grid, len(range(message.width)[GRID])),
        )
    except ValueError as error:
        raise RefusedInput("invalid_message", f"frame graph: {error}") from error


def _rgb(content: bytes, columns: int) -> UInt8 | None:
    return np.frombuffer(content, np.uint8).reshape(-1, columns, 3) if content else None


def local_graph_to_message(graph: LocalGraph) -> wire.LocalGraphMessage:
    """The message of a local 3D graph."""
    colours = _colours_to_wire(graph.colours_lab, len(graph))
    embeddings = _embeddings_to_wire(graph.embeddings, len(graph))
    return wire.LocalGraphMessage(
        schema=wire.schema_of(wire.LocalGraphMessage),
        stamp=wire.stamp_from_ns(graph.stamp_ns),
        frame_id=graph.frame_id,
        width=graph.width,
        height=graph.height,
        T_world_camera=graph.T_world_camera.ravel().tolist(),
        classes=list(graph.vocabulary.classes),
        predicates=list(graph.vocabulary.predicates),
        objects=[
            wire.LiftedObject(
                instance=int(graph.instance_ids[row]),
                box_xyxy=graph.boxes_xyxy[row].tolist(),
                score=float(graph.scores[row]),
                class_probabilities=graph.class_probabilities[row].tolist(),
                mean_m=graph.means_world[row].tolist(),
                covariance_m2=graph.covariances_world[row].ravel().tolist(),
                depth_m=float(graph.depths_m[row]),
                pixel_count=int(graph.pixel_counts[row]),
                surface=graph.surface_points_world[row].astype("<f4").tobytes(),
                colour_lab=colours[row],
                embedding=embeddings[row],
            )
            for row in range(len(graph))
        ],
        relations=_relations_to_wire(graph.relations),
        drops=dict(graph.drops),
        depth_grid=_depth_grid_to_wire(graph.depth_grid),
        embedding_model=UNSET if graph.embeddings is None else graph.embeddings.model,
    )


def local_graph_from_message(message: wire.LocalGraphMessage) -> LocalGraph:
    """The local 3D graph of a message; ``invalid_message`` if its parts do not fit."""
    objects = message.objects
    try:
        return LocalGraph(
            stamp_ns=wire.ns_from_stamp(message.stamp),
            frame_id=message.frame_id,
            width=message.width,
            height=message.height,
            T_world_camera=np.array(message.T_world_camera, np.float64).reshape(4, 4),
            vocabulary=_vocabulary(tuple(message.classes), tuple(message.predicates)),
            instance_ids=np.array([item.instance for item in objects], np.int64),
            boxes_xyxy=_rows([item.box_xyxy for item in objects], 4, "box"),
            class_probabilities=_rows(
                [item.class_probabilities for item in objects],
                len(message.classes),
                "class probabilities",
            ),
            scores=np.array([item.score for item in objects], np.float64),
            means_world=_rows([item.mean_m for item in objects], 3, "mean"),
            covariances_world=_rows(
                [item.covariance_m2 for item in objects], 9, "covariance"
            ).reshape(-1, 3, 3),
            depths_m=np.array([item.depth_m for item in objects], np.float64),
            pixel_counts=np.array([item.pixel_count for item in objects], np.int64),
            surface_points_world=tuple([_surface(item, message.schema) for item in objects]),
            relations=_relations_from_wire(message.relations, len(message.predicates)),
            drops=message.drops,
            depth_grid=_depth_grid_from_wire(message),
            colours_lab=_colours_from_wire(objects),
            embeddings=_embeddings_from_wire(objects, message.embedding_model),
        )
    except ValueError as error:
        raise RefusedInput("invalid_message", f"local graph: {error}") from error


def _surface(item: wire.LiftedObject, schema: wire.Schema) -> Float32:
    """The surface points (k, 3) of an object in a message of any version."""
    if (item.surface_points_m is UNSET) != (schema.version > 1):
        raise ValueError(
            f"object {item.instance} of version {schema.version}: version 1 has surface_points_m, "
            "and later ones have surface"
        )
    if item.surface_points_m is UNSET:
        return np.frombuffer(item.surface, "<f4").reshape(-1, 3).astype(np.float32)
    return np.array(item.surface_points_m, np.float32).reshape(-1, 3)


def _depth_grid_to_wire(grid: DepthGrid | None) -> wire.DepthGridState | None:
    if grid is None:
        return None
    camera = grid.intrinsics
    return wire.DepthGridState(
        stride_px=grid.stride_px,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        depth_mm=grid.depth_mm.astype("<u2").tobytes(),
        instances=b"" if grid.instances is None else grid.instances.astype("<u2").tobytes(),
        rgb=b"" if grid.rgb is None else grid.rgb.tobytes(),
    )


def _depth_grid_from_wire(message: wire.LocalGraphMessage) -> DepthGrid | None:
    state = message.depth_grid
    if state is None:
        return None
    columns = len(range(state.stride_px // 2, message.width, state.stride_px))

    def pixels(content: bytes) -> UInt16:
        return np.frombuffer(content, "<u2").reshape(-1, columns).astype(np.uint16)

    return DepthGrid(
        pixels(state.depth_mm),
        state.stride_px,
        Intrinsics(state.fx, state.fy, state.cx, state.cy, message.width, message.height),
        pixels(state.instances) if state.instances else None,
        _rgb(state.rgb, columns),
    )


def evidence_to_message(evidence: RelationEvidence, frame_id: str) -> wire.RelationEvidenceMessage:
    """The message of relation evidence; `frame_id` is the world frame."""
    predicted = evidence.predicted
    return wire.RelationEvidenceMessage(
        schema=wire.schema_of(wire.RelationEvidenceMessage),
        stamp=wire.stamp_from_ns(evidence.stamp_ns),
        frame_id=frame_id,
        classes=list(evidence.vocabulary.classes),
        predicates=list(evidence.vocabulary.predicates),
        source=evidence.source,
        pairs=[
            wire.PairEvidence(
                subject=int(evidence.pairs[row, 0]),
                object=int(evidence.pairs[row, 1]),
                subject_class=int(evidence.pair_classes[row, 0]),
                object_class=int(evidence.pair_classes[row, 1]),
                geo_cost=float(evidence.geo_costs[row]),
                prediction=evidence.predictions[row].tolist() if predicted[row] else [],
            )
            for row in range(len(evidence.pairs))
        ],
    )


def evidence_from_message(message: wire.RelationEvidenceMessage) -> RelationEvidence:
    """The relation evidence of a message; ``invalid_message`` if its parts do not fit."""
    pairs = message.pairs
    try:
        return RelationEvidence(
            stamp_ns=wire.ns_from_stamp(message.stamp),
            vocabulary=_vocabulary(tuple(message.classes), tuple(message.predicates)),
            pairs=np.array([[item.subject, item.object] for item in pairs], np.int64).reshape(
                -1, 2
            ),
            pair_classes=np.array(
                [[item.subject_class, item.object_class] for item in pairs], np.int64
            ).reshape(-1, 2),
            geo_costs=np.array([item.geo_cost for item in pairs], np.float64),
            predictions=_predictions(pairs, len(message.predicates)),
            source=message.source,
        )
    except ValueError as error:
        raise RefusedInput("invalid_message", f"relation evidence: {error}") from error

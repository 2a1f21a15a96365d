"""Accuracy of trained probes on drawn rooms, and their effect on edges.

    python bench/probe.py [--rooms 16] [--pairs 30] [--out FOLDER]

Some rooms are held out of training. The rooms are those of `test/support/pair_rooms.py`. The
backbones are tiny and have random weights, so no checkpoint is needed. The results do not predict
those of published models.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.special import entr, softmax

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test"))

from support.checkpoints import save_dinov2, save_vjepa2
from support.pair_rooms import CLASSES, PREDICATES, PairClip, render_room

from deworldsg_ros.checkpoints.cards import BackboneIdentity, TrainingOptions, relative_box_pair
from deworldsg_ros.checkpoints.probe_network import load_probe
from deworldsg_ros.config import RelationsConfig
from deworldsg_ros.relations import ClassPairPrior, clip_models, fuse_edges, union_box
from deworldsg_ros.relations.clip_models import FrozenBackbone, ProbedWorldModel
from deworldsg_ros.relations.world_model import ClipRequest, PairContext
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.training.clips import LabelledClip
from deworldsg_ros.training.train import train_probe

VOCABULARY = Vocabulary(CLASSES, PREDICATES)
DEFAULTS = RelationsConfig()


def request_of(pair: PairClip) -> ClipRequest:
    """The request of the relations stage for a pair: union crop, both directions."""
    height, width = pair.frames.shape[1:3]
    x1, y1, x2, y2 = union_box(*pair.boxes_xyxy, width, height)
    boxes = [box - np.array([x1, y1, x1, y1]) for box in pair.boxes_xyxy]
    names = pair.subject_class, pair.object_class
    contexts = tuple(
        PairContext(boxes[s], boxes[o], *(CLASSES.index(names[end]) for end in (s, o)), *ends)
        for s, o, ends in ((0, 1, names), (1, 0, names[::-1]))
    )
    return ClipRequest(pair.frames[:, y1:y2, x1:x2], contexts, VOCABULARY)


def labelled(pair: PairClip, number: int) -> LabelledClip:
    request = request_of(pair)
    height, width = request.clip.shape[1:3]
    context = request.pairs[0]
    boxes = relative_box_pair(context.subject_box_xyxy, context.object_box_xyxy, width, height)
    name = f"{pair.room} {number}"
    return LabelledClip(name, pair.room, name, (pair.predicate,), boxes, lambda: request.clip)


def ambiguous_logits(truth: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Logits whose softmax is uncertain (> 1 nat) and slightly favours the true predicate."""
    rows = []
    for true in truth:
        while True:
            logits = generator.normal(0, 0.7, len(PREDICATES))
            logits[true] += 0.5
            if entr(softmax(logits)).sum() > DEFAULTS.entropy_threshold_nats:
                rows.append(logits)
                break
    return np.array(rows)


def on_and_off(model, pairs: list[PairClip], seed: int) -> dict[str, float]:
    """Edges of held-out pairs with the world model off and on, by Eq. 9 and 10."""
    generator = np.random.default_rng(seed)
    prior = ClassPairPrior(len(CLASSES), len(PREDICATES))
    classes = []
    for pair in pairs:
        request = request_of(pair)
        predictions = model.predict(request)
        rows = [(context.subject_class, context.object_class) for context in request.pairs]
        prior.update(np.array(rows), predictions)
        classes.append(rows[0])
    truth = np.array([PREDICATES.index(pair.predicate) for pair in pairs])
    logits = ambiguous_logits(truth, generator)
    priors, has_prior = prior.lookup(np.array(classes))
    has_visual = np.ones(len(pairs), bool)
    results = {}
    for name, active in (("off", np.zeros_like(has_prior)), ("on", has_prior)):
        edges = fuse_edges(
            logits,
            has_visual,
            priors,
            active,
            DEFAULTS.fusion_alpha,
            DEFAULTS.entropy_threshold_nats,
        ).probabilities
        correct = edges.argmax(axis=1) == truth
        results[name] = float(correct.mean())
        results[f"probability {name}"] = float(edges[np.arange(len(truth)), truth].mean())
        results[f"_{name}"] = correct
    off, on = results.pop("_off"), results.pop("_on")
    return {
        **results,
        "to correct": int((on & ~off).sum()),
        "to wrong": int((off & ~on).sum()),
        "edges": len(pairs),
    }


def blind(backbone: FrozenBackbone) -> FrozenBackbone:
    """A backbone without features, to measure the effect of the boxes alone."""
    identity = BackboneIdentity("blind", 1, backbone.identity.image_size, DEFAULTS.clip_length)
    return replace(
        backbone, identity=identity, features=lambda videos: videos.new_zeros((len(videos), 1))
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=16, help="number of rooms")
    parser.add_argument("--pairs", type=int, default=30, help="pairs per room")
    parser.add_argument("--held-out", type=int, default=4, help="rooms held out of training")
    parser.add_argument("--out", type=Path, help="folder for checkpoints and probes")
    options = parser.parse_args()
    out = options.out or Path(tempfile.mkdtemp())

    pairs = [pair for room in range(options.rooms) for pair in render_room(room, options.pairs)]
    clips = [labelled(pair, number) for number, pair in enumerate(pairs)]
    held = tuple(f"room {room}" for room in range(options.held_out))
    held_pairs = [pair for pair in pairs if pair.room in held]
    print(f"{options.rooms} rooms, {len(pairs)} clips, {len(held_pairs)} of them in held-out rooms")
    loaders = {
        "vjepa2": (clip_models.load_vjepa2, save_vjepa2, {"crop_size": 64, "hidden_size": 96}),
        "dinov2": (
            partial(clip_models.load_dinov2, image_size=56),
            save_dinov2,
            {"image_size": 56, "hidden_size": 96},
        ),
    }
    backbones = {}
    for family, (load, save, sizes) in loaders.items():
        folder = str(save(out / family, **sizes))
        config = RelationsConfig(world_model=family, world_model_path=folder)
        backbones[family] = load(config, device="cpu")
    backbones["boxes alone"] = blind(backbones["dinov2"])
    for family, backbone in backbones.items():
        for inputs in ("clip", "clip_and_boxes"):
            if backbone.identity.family == "blind" and inputs == "clip":
                continue
            start = time.perf_counter()
            folder = out / f"probe {family} {inputs}"
            metrics = train_probe(
                backbone,
                clips,
                PREDICATES,
                folder,
                TrainingOptions(inputs=inputs, held_out_groups=held, batch_size=16),
                cache=out / "features",
            )["held_out"]
            print(
                f"{family}, {inputs}: held-out macro {metrics['macro_accuracy']:.3f} (chance "
                f"{metrics['chance_macro']:.3f}), micro {metrics['micro_accuracy']:.3f}; "
                f"{time.perf_counter() - start:.0f} s"
            )
            edges = on_and_off(ProbedWorldModel(backbone, load_probe(folder)), held_pairs, seed=5)
            print(
                f"  ambiguous edges: correct {edges['off']:.3f} off, {edges['on']:.3f} on; "
                f"probability of the true predicate {edges['probability off']:.3f} "
                f"off, {edges['probability on']:.3f} on; {edges['to correct']} became correct, "
                f"{edges['to wrong']} became wrong, of {edges['edges']}"
            )


if __name__ == "__main__":
    main()

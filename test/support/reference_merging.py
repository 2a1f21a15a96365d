"""Plain reference of the merge rule of Eq. 5-7, with dicts and loops."""

import math

import numpy as np

from deworldsg_ros.scene.frame_graph import LocalGraph


def hellinger(mean_i, covariance_i, mean_j, covariance_j) -> float:
    mixed = (covariance_i + covariance_j) / 2
    difference = mean_i - mean_j
    exponent = difference @ np.linalg.inv(mixed) @ difference / 8 + 0.5 * math.log(
        np.linalg.det(mixed) / math.sqrt(np.linalg.det(covariance_i) * np.linalg.det(covariance_j))
    )
    return math.sqrt(1 - math.exp(-max(exponent, 0.0)))


class ReferenceMerging:
    """Nodes and edges by id; `smallest_margin` is the minimum distance to a threshold."""

    def __init__(self, hellinger_threshold: float, class_distance_threshold: float) -> None:
        self.hellinger_threshold = hellinger_threshold
        self.class_distance_threshold = class_distance_threshold
        self.nodes: dict[int, dict] = {}
        self.edges: dict[tuple[int, int], dict] = {}
        self.merged_into: dict[int, int] = {}
        self.next_id = 1
        self.smallest_margin = math.inf

    def merge(self, local: LocalGraph) -> list[int]:
        assigned = []
        for row in range(len(local)):
            observed = {
                "mean": local.means_world[row],
                "covariance": local.covariances_world[row],
                "classes": local.class_probabilities[row],
                "weight": 1,
                "points": {tuple(point) for point in local.surface_points_world[row].tolist()},
            }
            node_id = self.find(observed, self.nodes)
            if node_id is None:
                node_id = self.next_id
                self.next_id += 1
                self.nodes[node_id] = observed
            else:
                self.nodes[node_id] = self.fused(self.nodes[node_id], observed)
                node_id = self.merge_repeatedly(node_id)
            assigned.append(node_id)
        assigned = [self.resolve(node_id) for node_id in assigned]
        seen_now = set()
        for (subject, object_), logits in zip(local.relations.pairs, local.relations.logits):
            pair = (assigned[subject], assigned[object_])
            if pair[0] == pair[1]:
                continue
            edge = self.edges.setdefault(pair, {"logits": np.zeros(len(logits)), "frames": 0})
            edge["logits"] = edge["logits"] + logits
            edge["frames"] += pair not in seen_now
            seen_now.add(pair)
        return assigned

    def merge_repeatedly(self, node_id: int) -> int:
        while True:
            others = {other: node for other, node in self.nodes.items() if other != node_id}
            other_id = self.find(self.nodes[node_id], others)
            if other_id is None:
                return node_id
            kept, removed = sorted((node_id, other_id))
            self.nodes[kept] = self.fused(self.nodes[kept], self.nodes.pop(removed))
            self.merged_into[removed] = kept
            edges, self.edges = self.edges, {}
            for (subject, object_), edge in edges.items():
                pair = (
                    kept if subject == removed else subject,
                    kept if object_ == removed else object_,
                )
                if pair[0] == pair[1]:
                    continue
                known = self.edges.setdefault(pair, {"logits": 0.0, "frames": 0})
                known["logits"] = known["logits"] + edge["logits"]
                known["frames"] += edge["frames"]
            node_id = kept

    def find(self, observed: dict, nodes: dict[int, dict]) -> int | None:
        passing = []
        for node_id in sorted(nodes):
            node = nodes[node_id]
            distance = hellinger(
                observed["mean"], observed["covariance"], node["mean"], node["covariance"]
            )
            class_distance = 1 - sum(
                p * q for p, q in zip(observed["classes"].tolist(), node["classes"].tolist())
            )
            self.smallest_margin = min(
                self.smallest_margin,
                abs(distance - self.hellinger_threshold),
                abs(class_distance - self.class_distance_threshold),
            )
            if (
                distance < self.hellinger_threshold
                and class_distance < self.class_distance_threshold
            ):
                passing.append((distance, node_id))
        passing.sort()
        if len(passing) > 1:
            self.smallest_margin = min(self.smallest_margin, passing[1][0] - passing[0][0])
        return passing[0][1] if passing else None

    def resolve(self, node_id: int) -> int:
        while node_id in self.merged_into:
            node_id = self.merged_into[node_id]
        return node_id

    @staticmethod
    def fused(i: dict, j: dict) -> dict:
        w_i, w_j = i["weight"], j["weight"]
        total = w_i + w_j
        difference = i["mean"] - j["mean"]
        return {
            "mean": (w_i * i["mean"] + w_j * j["mean"]) / total,
            "covariance": (w_i * i["covariance"] + w_j * j["covariance"]) / total
            + w_i * w_j / total**2 * np.outer(difference, difference),
            "classes": (w_i * i["classes"] + w_j * j["classes"]) / total,
            "weight": total,
            "points": i["points"] | j["points"],
        }

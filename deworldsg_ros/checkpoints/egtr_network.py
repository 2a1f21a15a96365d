"""The relation head EGTR: a network on the self-attention of a DETR's decoder.

Im et al., "EGTR: Extracting Graph from Transformer for Scene Graph Generation", 2024, in the
version of FROSS for RT-DETR. Pairs are independent of each other. The head therefore runs on the
kept queries only, with the same result as on all 300, at a thousandth of the cost.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn

from deworldsg_ros.checkpoints.loading import check_names
from deworldsg_ros.scene.errors import ConfigurationError


class EgtrNetwork(nn.Module):
    """Relation and connectivity logits of all ordered pairs of queries.

    The parameters have the names of the published checkpoints.

    Args:
        width: d, features of a query.
        layers: L, layers of the decoder in training.
        predicates: R, number of predicates.
        frequency_shape: (C', C', R), shape of the class-pair statistics; None = no statistics. C'
            is the number of classes, or one more if training had a background class.
    """

    def __init__(
        self,
        width: int,
        layers: int,
        predicates: int,
        frequency_shape: tuple[int, int, int] | None = None,
    ) -> None:
        super().__init__()
        self.predicates = predicates
        self.proj_q = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.proj_k = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.final_sub_proj = nn.Linear(width, width)
        self.final_obj_proj = nn.Linear(width, width)
        self.rel_predictor_gate = nn.Linear(2 * width, 1)
        self.rel_predictor = Perceptron(2 * width, width, predicates)
        self.connectivity_layer = Perceptron(2 * width, width, 1)
        if frequency_shape is not None:
            self.triplet_dist = nn.Parameter(torch.zeros(frequency_shape), requires_grad=False)
            self.rel_dist = nn.Parameter(torch.zeros(predicates), requires_grad=False)

    @staticmethod
    def for_parameters(parameters: Mapping[str, torch.Tensor], where: str) -> EgtrNetwork:
        """A network of the sizes of these parameters, with their values.

        Args:
            parameters: by name.
            where: origin of the parameters, for messages.

        Raises:
            ConfigurationError: parameters are missing or unknown, or have other sizes.
        """
        width = _rows(parameters, "final_sub_proj.weight", where)
        predicates = _rows(parameters, "rel_predictor.layers.2.weight", where)
        layers = sum(name.startswith("proj_q.") and name.endswith(".weight") for name in parameters)
        frequencies = parameters.get("triplet_dist")
        shape = None if frequencies is None else tuple(frequencies.shape)
        if shape is not None and (len(shape) != 3 or shape[2] != predicates):
            raise ConfigurationError(
                f"{where}: triplet_dist has shape {shape}, "
                f"expected (classes, classes, {predicates})"
            )
        network = EgtrNetwork(width, layers, predicates, shape)
        check_names(parameters, network.state_dict(), where)
        try:
            network.load_state_dict(parameters)
        except RuntimeError as error:
            reason = str(error).splitlines()[-1].strip()
            raise ConfigurationError(f"{where} is not an EGTR head: {reason}") from error
        return network.eval().requires_grad_(False)

    def forward(
        self, features: torch.Tensor, classes: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Relation logits (n, n, R) and connectivity logits (n, n), subject first.

        Args:
            features: (n, 2 l + 1, d): projected queries of the first l <= L layers of the
                decoder, projected keys of the same layers, and the last hidden state.
            classes: (n,) most probable class of each query, to add the class-pair statistics;
                None = without them.
        """
        used = (features.shape[1] - 1) // 2
        # One slot per layer, and one more for the last hidden state.
        subjects = [self.proj_q[layer](features[:, layer]) for layer in range(used)]
        subjects.append(self.final_sub_proj(features[:, -1]))
        objects = [self.proj_k[layer](features[:, used + layer]) for layer in range(used)]
        objects.append(self.final_obj_proj(features[:, -1]))
        q, k = torch.stack(subjects, dim=1), torch.stack(objects, dim=1)  # (n, l + 1, d)
        # The gate is linear in [q_i; k_j]: the sum of a subject part and an object part.
        width = q.shape[-1]
        weight, bias = self.rel_predictor_gate.weight[0], self.rel_predictor_gate.bias
        gate_q, gate_k = q @ weight[:width], k @ weight[width:]
        gates = torch.sigmoid(gate_q[:, None] + gate_k[None] + bias)  # (n, n, l + 1)
        pairs = torch.cat(
            [torch.einsum("ijl,ild->ijd", gates, q), torch.einsum("ijl,jld->ijd", gates, k)], dim=-1
        )
        relations = self.rel_predictor(pairs)
        if classes is not None:
            relations = relations + self.triplet_dist[classes][:, classes]
        return relations, self.connectivity_layer(pairs)[..., 0]


class Perceptron(nn.Module):
    """Three linear layers with ReLU between them."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [nn.Linear(inputs, width), nn.Linear(width, width), nn.Linear(width, outputs)]
        )

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        """(..., inputs) to (..., outputs)."""
        first, second, last = self.layers
        result: torch.Tensor = last(second(first(values).relu()).relu())
        return result


def _rows(parameters: Mapping[str, torch.Tensor], name: str, where: str) -> int:
    if name not in parameters:
        raise ConfigurationError(f"{where} has unexpected parameters: 1 missing ({name})")
    return len(parameters[name])

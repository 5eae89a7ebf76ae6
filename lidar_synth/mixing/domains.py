"""Real and synthetic scans as two domains of one training: weights of the loss, statistics of the
normalisation, and layers of their own."""

from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from lidar_synth.errors import ConfigError
from lidar_synth.mixing.schedules import Schedule, make_schedule, share_of

Forward = Callable[[nn.Module, Any], Any]


def make_weight(weight: Any, epoch: int = 0) -> Schedule:
    """The weight of synthetic samples in the loss, by epoch.

    Args:
        weight: a number from 0 to 1, or one by epoch in any form of ``make_schedule``.
        epoch: an epoch that needs a weight.

    Raises:
        ConfigError: on anything else, or without a weight for the epoch.
    """
    given = f"loss_weight={weight!r}"
    try:
        schedule = make_schedule(weight)
        given = f"loss_weight in epoch {epoch}"
        share_of(schedule, epoch)
        return schedule
    except ConfigError as error:
        raise ConfigError(
            given,
            "the weight of synthetic samples in the loss, from 0 to 1, or one by epoch, such as "
            "{0: 1.0, 10: 0.1}, whose last one stays",
        ) from error


def settle(
    model: nn.Module, batches: Iterable[Any], forward: Forward | None = None
) -> nn.Module:
    """A copy of a network whose batch normalisation has the statistics of some batches, in
    evaluation mode.

    After training on a mixture, the statistics are those of real and synthetic scans together. A
    network that is used on real scans needs those of real scans; they need no labels. A training
    that ends on real scans, such as with ``mix(epochs=40)``, needs no ``settle``. A layer that
    sees no batch, such as the synthetic one of a ``ByDomain``, keeps its statistics.

    Args:
        model: the trained network; it stays as it is.
        batches: of real scans, such as 20 of ``MixedScans(real, ratio=0,
            unlabelled="allow").loader(4)``.
        forward: runs the network on a batch; by default ``model(batch)``.

    Raises:
        ConfigError: without a batch.

    Example:
        >>> import torch
        >>> from lidar_synth.mixing import settle
        >>> network = torch.nn.BatchNorm1d(1)
        >>> settled = settle(network, [torch.full((4, 1), 3.0)])
        >>> settled.running_mean, network.running_mean
        (tensor([3.]), tensor([0.]))
    """
    settled = deepcopy(model).eval().train()  # eval() sets ByDomain to its real layer
    norms, originals = (
        [module for module in network.modules() if isinstance(module, _BatchNorm)]
        for network in (settled, model)
    )
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None  # the mean of all batches
    run = settled if forward is None else partial(forward, settled)
    count = 0
    with torch.no_grad():
        for batch in batches:
            run(batch)
            count += 1
    if not count:
        raise ConfigError("no batch to settle on", "batches of real scans")
    for norm, original in zip(norms, originals, strict=True):
        norm.momentum = original.momentum
        if norm.num_batches_tracked == 0:
            norm.load_state_dict(original.state_dict())
    return settled.eval()


class ByDomain(nn.Module):
    """A layer with a copy for each domain, such as the first one, a normalisation or a head.

    Args:
        layer: the layer that both domains begin with.

    Attributes:
        domain: (B,) the domain of each sample of the next batch, 0 real, 1 synthetic; set it
            before the network runs. None takes the real layer; ``eval()`` sets it to None.

    Example:
        >>> import torch
        >>> from lidar_synth.mixing import ByDomain
        >>> network = torch.nn.Sequential(ByDomain(torch.nn.Linear(4, 8)), torch.nn.ReLU())
        >>> network[0].domain = torch.tensor([0, 1, 1])  # batch["domain"]
        >>> network(torch.zeros(3, 4)).shape
        torch.Size([3, 8])
    """

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layers = nn.ModuleList([layer, deepcopy(layer)])
        self.domain: Tensor | None = None

    def train(self, mode: bool = True) -> Any:
        """Set the mode; evaluation mode forgets the domains of the last training batch."""
        if not mode:
            self.domain = None
        return super().train(mode)

    def forward(self, x: Tensor) -> Tensor:
        """The output (B, ...) of each sample (B, ...) by the layer of its domain.

        Raises:
            ConfigError: on another number of samples than of domains, or a domain that is neither 0
                nor 1.
        """
        if self.domain is None:
            return self.layers[0](x)  # type: ignore[no-any-return]
        by_domain = [torch.nonzero(self.domain == number)[:, 0] for number in (0, 1)]
        known = sum(map(len, by_domain))
        if not known == len(self.domain) == len(x):
            raise ConfigError(
                f"{len(self.domain)} domains for {len(x)} rows, {known} of them 0 or 1",
                "a domain for each row, 0 real or 1 synthetic",
                "For concatenated points: "
                'batch["domain"].repeat_interleave(batch["offsets"].diff()).',
            )
        parts = [
            layer(x[indices])
            for layer, indices in zip(self.layers, by_domain, strict=True)
            if len(indices) or not known
        ]
        return torch.cat(parts)[torch.argsort(torch.cat(by_domain))]

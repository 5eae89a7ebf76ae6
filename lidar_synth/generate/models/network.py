"""Base classes of all networks that a checkpoint can hold. Class attributes state what a training
run provides."""

from typing import ClassVar

from torch import nn


class Network(nn.Module):
    """A velocity network, an autoencoder, or an encoder of conditions (``Encoder``).

    Attributes:
        derived_arguments: names of the arguments that a training run sets itself. For a velocity
            network or an autoencoder: some of "resolution" and "channels" (of the states or images)
            and "normalisation" (its name). For an encoder: some of "resolution" (of the sensor),
            "target" (rows and columns of the state) and "image" (rows and columns of the camera's
            images).
        needs_ray_angles: whether a network with fresh weights takes ``angles``, (2, H, W) elevation
            and azimuth of the cells of the state in radians; a checkpoint stores them among the
            weights.
        is_autoencoder: whether the network maps range images to latents and back.
        decodes_given: the conditions that its ``decode`` takes and follows exactly: "layout"
            (objects in their boxes only) and "semantic" (the labels of the map).
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ("resolution", "channels")
    needs_ray_angles: ClassVar[bool] = False
    is_autoencoder: ClassVar[bool] = False
    decodes_given: ClassVar[frozenset[str]] = frozenset()


class Encoder(Network):
    """An encoder of conditions, trained with the velocity network. It takes conditions as they are
    stored, uint8.

    Attributes:
        condition: the kind of condition that it encodes, a key of
            ``generate.conditions.CONDITIONS``.
        argument: the velocity network's argument that takes ``channels``: "condition_channels" for
            maps on the grid of the state, "context_channels" for tokens.
        channels: number of channels of the maps or tokens.
    """

    derived_arguments: ClassVar[tuple[str, ...]] = ()
    condition: ClassVar[str]
    argument: ClassVar[str]
    channels: int

"""Label policies of synthetic scans by name, and objects that are pasted into scans.

Each name is imported when it is first used: editing loads networks, which a mixture does not need.
"""

from functools import partial
from typing import TYPE_CHECKING

from lidar_synth.errors import import_name

_HOME = {
    "POLICIES": "policies",
    "LabelPolicy": "policies",
    "Object": "objects",
    "ObjectBank": "bank",
    "draw_objects": "draw",
    "instances_of": "objects",
    "make_policy": "policies",
    "objects_of": "objects",
    "paste": "pasting",
    "swap_bands": "exchange",
    "swap_sector": "exchange",
    "thin_scan": "exchange",
}

__all__ = list(_HOME)

if TYPE_CHECKING:
    from lidar_synth.labels.bank import ObjectBank as ObjectBank
    from lidar_synth.labels.draw import draw_objects as draw_objects
    from lidar_synth.labels.exchange import (
        swap_bands as swap_bands,
        swap_sector as swap_sector,
        thin_scan as thin_scan,
    )
    from lidar_synth.labels.objects import (
        Object as Object,
        instances_of as instances_of,
        objects_of as objects_of,
    )
    from lidar_synth.labels.pasting import paste as paste
    from lidar_synth.labels.policies import (
        POLICIES as POLICIES,
        LabelPolicy as LabelPolicy,
        make_policy as make_policy,
    )

__getattr__ = partial(import_name, __name__, _HOME)

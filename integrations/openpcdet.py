"""OpenPCDet: datasets that mix KITTI or nuScenes with synthetic scans, and a launcher of its own
``tools/train.py``::

    cd OpenPCDet/tools
    LIDAR_SYNTH_MIX=/data/mix.yaml python -m lidar_synth.integrations.openpcdet train.py \\
        --cfg_file cfgs/kitti_models/pointpillar.yaml --set DATA_CONFIG.DATASET MixedKitti

The settings (``mixing.settings.OPTIONS``) may also be in the data configuration, under
``LIDAR_SYNTH``; its reader takes no ratio by epoch, {epoch: ratio}, because keys must be names
there.
OpenPCDet's files stay unchanged, and its own code processes real samples.
"""

from collections.abc import Iterator
from itertools import islice
from typing import Any

from lidar_synth.integrations.launcher import prepare_script, run
from lidar_synth.integrations.weights import weigh_openpcdet
from torch.utils.data import Sampler, SequentialSampler

from lidar_synth.errors import LibraryError

try:
    import pcdet.datasets
except ImportError as error:
    raise LibraryError(
        f"pcdet cannot be imported ({error})",
        "OpenPCDet 0.6, built in its checkout",
        "python setup.py develop",
    ) from error

if not pcdet.__version__.startswith("0.6."):
    raise LibraryError(
        f"OpenPCDet {pcdet.__version__}",
        "0.6",
        "git checkout v0.6.0, python setup.py develop",
    )

from lidar_synth.integrations.openpcdet_kitti import MixedKitti
from lidar_synth.integrations.openpcdet_nuscenes import MixedNuScenes

DATASETS: dict[str, Any] = {"MixedKitti": MixedKitti, "MixedNuScenes": MixedNuScenes}


def register() -> None:
    """Register ``DATASETS`` with OpenPCDet, as values of ``DATASET``."""
    pcdet.datasets.__all__.update(DATASETS)


class Rest(Sampler[int]):
    """The positions of an epoch in a sampler's order, the first time without those before
    ``skipped``.

    Args:
        whole: the sampler of whole epochs.
    """

    def __init__(self, whole: Any) -> None:
        self.whole = whole
        self.skipped = 0

    def __iter__(self) -> Iterator[int]:
        skipped = self.skipped
        self.skipped = 0
        return islice(iter(self.whole), skipped, None)

    def __len__(self) -> int:
        return len(self.whole)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the sampler of several GPUs."""
        self.whole.set_epoch(epoch)


def _is_mixed(loader: Any) -> bool:
    return isinstance(loader.dataset, tuple(DATASETS.values()))


def tell_epochs() -> None:
    """Make OpenPCDet's training loop set the epoch of a mixture, and resume in the middle of one;
    ``tools`` must be on the path.

    The plan is the order of a mixture, so that a run resumed from ``latest_model`` continues after
    its last batch. OpenPCDet itself would take the rest of the epoch from a new order.
    """
    from train_utils import train_utils as loop

    whole_training = loop.train_model
    one_epoch = loop.train_one_epoch

    def train_model(
        model: Any, optimizer: Any, train_loader: Any, *args: Any, **options: Any
    ) -> Any:
        if _is_mixed(train_loader):
            batches = train_loader.batch_sampler
            several = options.get("train_sampler") is not None
            batches.sampler = Rest(
                batches.sampler if several else SequentialSampler(train_loader.dataset)
            )
            # No samples for the iterator that OpenPCDet makes first and does not use.
            batches.sampler.skipped = len(batches.sampler)
            if train_loader.dataset.weighed:
                weigh_openpcdet(model)
        return whole_training(model, optimizer, train_loader, *args, **options)

    def train_one_epoch(
        model: Any, optimizer: Any, train_loader: Any, *args: Any, **options: Any
    ) -> Any:
        if _is_mixed(train_loader):
            train_loader.dataset.set_epoch(options["cur_epoch"])
            done = options["accumulated_iter"] % options["total_it_each_epoch"]
            train_loader.batch_sampler.sampler.skipped = done * train_loader.batch_size
        return one_epoch(model, optimizer, train_loader, *args, **options)

    loop.train_model = train_model
    loop.train_one_epoch = train_one_epoch


def main() -> None:
    """Run one of OpenPCDet's scripts with the datasets registered: ``train.py`` or ``test.py`` and
    its arguments."""
    script = prepare_script(
        "cd OpenPCDet/tools; python -m lidar_synth.integrations.openpcdet train.py ARGUMENTS",
        "torch.load",  # else it trains from the beginning again instead of resuming
    )
    register()
    tell_epochs()
    run(script)


if __name__ == "__main__":
    main()

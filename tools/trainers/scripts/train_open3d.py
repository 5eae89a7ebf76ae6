"""The documented lines for Open3D-ML, on few points: ``python train_open3d.py SEMANTICKITTI MIX.yaml``."""

import logging
import sys
from pathlib import Path

import open3d.ml.torch as ml3d
from lidar_synth.integrations.open3d_ml import dataset_class
from open3d.ml.utils import Config

if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    dataset = dataset_class()(dataset_path=sys.argv[1], mixture=sys.argv[2])
    package = Path(sys.modules[ml3d.datasets.SemanticKITTI.__module__].__file__ or "").parent.parent
    config = Config.load_from_file(str(package / "configs" / "randlanet_semantickitti.yml"))
    model = ml3d.models.RandLANet(**config.model | {"in_channels": 4, "num_points": 4096})
    own = {"batch_size": 2, "val_batch_size": 1, "max_epoch": 1, "save_ckpt_freq": 1, "device": "cpu"}
    pipeline = ml3d.pipelines.SemanticSegmentation(model, dataset=dataset, **config.pipeline | own)
    pipeline.run_train()

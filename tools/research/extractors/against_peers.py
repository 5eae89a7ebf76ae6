"""Every extractor beside the peers' own code, with the same random weights of the published shapes,
on real scans.

    python tools/research/extractors/against_peers.py CLONES SCANS [--only NAME ...] [--scans N] [--golden FILE]

CLONES holds clones of the peers' repositories: LiDAR-Diffusion, r2flow, R3DPA, SpareNet,
lidar-bonnetal. SCANS holds ``.bin`` files of KITTI-360. Needs torchsparse 1.4.0 (a CPU build will
do), timm, torchvision and einops. Prints the largest difference of the features relative to the
largest feature, and the Fréchet distance between the two halves of the scans (of fixed sums of the
features) by our features and code, and by the peers'. ``--golden`` writes the peers' numbers on
random points and images for the tests.
"""

import argparse
import ast
import sys
import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from random_archives import WRITERS, write
from random_inputs import PER_SET, random_image, random_points, reduced, two_sets

from lidar_synth.geometry.projection import locate
from lidar_synth.geometry.scan import Scan
from lidar_synth.geometry.sensor import presets
from lidar_synth.lab.evaluate.distances import frechet_distance
from lidar_synth.lab.evaluate.extractors import EXTRACTORS, load_extractor

Points = NDArray[np.float32]


class Peer(NamedTuple):
    """A peer's extractor: features of points (N, 4), and of an input of its network (1, C, H, W) if
    it takes images."""

    features: Callable[[Points], NDArray[np.floating]]
    of_image: Callable[[torch.Tensor], NDArray[np.floating]] | None = None


def _functions(path: Path, names: Iterable[str], env: dict[str, Any]) -> Namespace:
    """Some functions of a file whose imports are not needed."""
    body = [
        n
        for n in ast.parse(path.read_text()).body
        if isinstance(n, ast.FunctionDef) and n.name in names
    ]
    for function in body:
        function.decorator_list = []
    exec(compile(ast.Module(body, []), str(path), "exec"), env)
    return Namespace(**{n: env[n] for n in names})


def _namespace(values: dict[str, Any]) -> Namespace:
    return Namespace(
        **{k: _namespace(v) if isinstance(v, dict) else v for k, v in values.items()}
    )


class R2Flow:
    """R2Flow's preprocessing of a real scan, and its extractors."""

    def __init__(self, clones: Path) -> None:
        sys.path.insert(0, str(clones / "r2flow"))
        loader = clones / "r2flow" / "r2flow" / "data" / "kitti_360" / "kitti_360.py"
        self.load = _functions(
            loader, ("scatter", "load_points_as_images"), {"np": np}
        ).load_points_as_images

    def image(self, points: Points) -> torch.Tensor:
        """(1, 5, 64, 1024) as its ``evaluate.py`` makes it from the dataset's images."""
        with tempfile.NamedTemporaryFile(suffix=".bin") as file:
            points.tofile(file.name)
            grid = torch.from_numpy(
                self.load(file.name, scan_unfolding=False, H=64, W=1024)
            ).permute(2, 0, 1)[None]
        xyz = grid[:, :3]
        rflct = grid[:, 3:4]
        depth = grid[:, 4:5]
        mask = grid[:, 5:6]
        return (
            torch.cat([depth, xyz, rflct], 1)
            * mask
            * torch.logical_and(depth > 0.5, depth < 63.0)
        )

    def rangenet(self, archive: Path, agg_type: str, channels: int) -> Peer:
        """RangeNet with R2Flow's loader; it reads a tar."""
        import tarfile

        from r2flow.metrics.models import rangenet

        packed = archive.with_suffix(".tar.gz")
        with tarfile.open(packed, "w:gz", compresslevel=1) as tar:
            tar.add(archive, arcname=archive.name)
        net, prepare = rangenet.build_rangenet(str(packed))
        pool = rangenet.PostProcess()

        def of_image(image: torch.Tensor) -> NDArray[np.floating]:
            return pool(net(image, feature="penultimate"), agg_type)[0].numpy()

        return Peer(lambda p: of_image(prepare(self.image(p)[:, :channels])), of_image)

    def pointnet(self, archive: Path) -> Peer:
        """PointNet on 65,536 points, those without a return at the origin."""
        from r2flow.metrics.models import pointnet

        net = pointnet.PointNet1(k=16)
        net.load_state_dict(torch.load(archive, weights_only=True))
        net.eval()
        return Peer(lambda p: net(self.image(p)[:, 1:4].flatten(2) / 80.0)[0].numpy())

    def voxels(self, archive: Path, module: str, name: str) -> Peer:
        """MinkowskiNet or SPVCNN with R2Flow's preprocessing."""
        import importlib

        from r2flow.metrics.models import utls

        model = getattr(
            importlib.import_module(f"r2flow.metrics.models.{module}"), name
        )
        net = _loaded(
            model(_namespace(yaml.safe_load((archive / "config.yaml").read_text()))),
            archive,
        )
        utls.unique = _unique
        before = utls.PreProcess()
        after = utls.PostProcess()
        return Peer(
            lambda p: after(net(before(self.image(p)[:, 1:4].flatten(2).mT)), "depth")[
                0
            ].numpy()
        )


def _unique(x: torch.Tensor, dim: int = 0) -> tuple[torch.Tensor, ...]:
    """R2Flow's ``unique``, which finds the first of equal values by float32 keys that tie, with a
    stable sort."""
    values, inverse, counts = torch.unique(
        x, dim=dim, sorted=True, return_inverse=True, return_counts=True
    )
    starts = torch.cat((counts.new_zeros(1), counts.cumsum(0)))[:-1]
    return values, inverse, counts, inverse.argsort(stable=True)[starts].sort().values


class LiDM:
    """LiDM's evaluation of clouds that were projected back from range images."""

    def __init__(self, clones: Path) -> None:
        sys.path.insert(0, str(clones / "LiDAR-Diffusion"))
        import lidm.eval.metric_utils as metrics
        from lidm.utils.lidar_utils import pcd2range, range2pcd

        self.metrics = metrics
        self.config = metrics.DATASET_CONFIG["kitti"]
        self.project = pcd2range
        self.unproject = range2pcd

    def cloud(self, points: Points) -> Points:
        """(N, 3) the returns of the range image."""
        image = self.project(points[:, :3], **self.config)[0]
        return self.unproject(
            image, self.config["fov"], self.config["depth_range"], 1, log_scale=False
        )[0].astype("f4")

    def image(self, points: Points) -> NDArray[np.floating]:
        """(4, 64, 1024) the cloud, projected again."""
        return self.metrics.preprocess_range(self.cloud(points), **self.config)

    def rangenet(self, archive: Path) -> Peer:
        """RangeNet-21 on the cloud, projected again."""
        from lidm.modules.rangenet.model import Model

        net = Model(yaml.safe_load((archive / "config.yaml").read_text()))
        net.load_pretrained_weights(str(archive))
        net.eval()

        def of_image(image: torch.Tensor) -> NDArray[np.floating]:
            return net(image, return_final_logits=True, agg_type="depth")[0]

        return Peer(
            lambda p: of_image(torch.from_numpy(self.image(p)[None]).float()), of_image
        )

    def voxels(self, archive: Path, module: str) -> Peer:
        """MinkowskiNet or SPVCNN."""
        import importlib

        model = importlib.import_module(f"lidm.modules.{module}.model").Model
        net = _loaded(
            model(_namespace(yaml.safe_load((archive / "config.yaml").read_text()))),
            archive,
        )

        def features(points: Points) -> NDArray[np.floating]:
            voxels = self.metrics.pcd2voxel(
                self.metrics.preprocess_pcd(self.cloud(points), **self.config)
            )
            out = net(
                self.metrics.sparse_collate_fn([voxels]), return_final_logits=True
            )
            return self.metrics.batch2list(out, "depth", **self.config)[0]

        return Peer(features)


class R3DPA:
    """R3DPA's range images of real scans, and its extractors of images."""

    def __init__(self, clones: Path) -> None:
        sys.path.insert(0, str(clones / "R3DPA"))
        env = {"np": np, "torch": torch}
        dataset = _functions(clones / "R3DPA" / "dataset_kitti.py", ("pcd2range",), env)
        config = yaml.safe_load(
            (clones / "R3DPA" / "configs" / "kitti.yaml").read_text()
        )
        self.arguments = {
            "size": config["size"],
            "fov": config["fov"],
            "depth_range": config["depth_range"],
        }
        self.project = dataset.pcd2range

    def image(self, points: Points) -> NDArray[np.float32]:
        """(2, 64, 1024) range in metres, -1 where there is none, and intensity."""
        depth, intensity = self.project(
            points[:, :3], labels=points[:, 3], **self.arguments
        )
        return np.stack([np.where(depth > 0, depth, -1), intensity]).astype(np.float32)

    def network(self, archive: Path, name: str) -> Peer:
        """RangeViT or LIP-Loc."""
        import importlib

        module = importlib.import_module(f"eval.models.{name}.model")
        settings = yaml.safe_load((archive / "config.yaml").read_text())
        model = module.RangeViT if name == "rangevit" else module.Model
        net = _loaded(model(_namespace(settings)), archive)

        def of_image(image: torch.Tensor) -> NDArray[np.floating]:
            inputs = ((image - net.image_mean) / net.image_std)[
                :, : settings["in_channels"]
            ]
            return (
                net.rangevit.forward_2d_features(inputs)[0]
                .unflatten(1, (8, -1))
                .mean((2, 3))
                .flatten()
                .numpy()
            )

        return Peer(
            lambda p: net([self.image(p)])[0].numpy(),
            of_image if name == "rangevit" else None,
        )


def _loaded(net: torch.nn.Module, archive: Path) -> torch.nn.Module:
    """Load a checkpoint as the peers do, and make sure that it reached every weight before the
    classifier."""
    state = torch.load(archive / "model.ckpt", weights_only=True)["state_dict"]
    missing, unexpected = net.load_state_dict(state, strict=False)
    assert not unexpected, unexpected
    assert all(k.startswith(("rangevit.kpclassifier", "image_")) for k in missing), (
        missing
    )
    return net.eval()


def _bonnetal(
    clones: Path,
    archive: Path,
    name: str,
    pool: Callable[[torch.Tensor, torch.Tensor], Any],
) -> Peer:
    """lidar-bonnetal's own network on its own projection; ``pool`` makes features of (1, C, H, W)
    and the image.

    Its projection takes the cell of the first point for empty: a point that another one hides is
    put first.
    """
    import importlib

    train = str(clones / "lidar-bonnetal" / "train")
    if train not in sys.path:
        sys.path.insert(0, train)
    from common.laserscan import LaserScan

    networks = (
        importlib.import_module(f"backbones.{name}"),
        importlib.import_module(f"tasks.semantic.decoders.{name}"),
    )
    settings = yaml.safe_load((archive / "arch_cfg.yaml").read_text())
    stride = {"squeezeseg": 16, "darknet": 32}[name]
    backbone = networks[0].Backbone(params=settings["backbone"] | {"OS": stride})
    _, skips = backbone(torch.zeros(1, 5, 64, 64))
    decoder = networks[1].Decoder(
        settings["decoder"], skips, OS=stride, feature_depth=backbone.get_last_depth()
    )
    backbone.load_state_dict(torch.load(archive / "backbone", weights_only=True))
    decoder.load_state_dict(
        torch.load(archive / "segmentation_decoder", weights_only=True)
    )
    backbone.eval(), decoder.eval()
    sensor = settings["dataset"]["sensor"]
    mean, std = (
        torch.tensor(sensor[k])[:, None, None] for k in ("img_means", "img_stds")
    )

    def of_image(image: torch.Tensor) -> NDArray[np.floating]:
        return pool(decoder(*backbone(image)), image).numpy()  # type: ignore[no-any-return]

    def features(points: Points) -> NDArray[np.floating]:
        scan = LaserScan(
            project=True, H=64, W=sensor["img_prop"]["width"], fov_up=3, fov_down=-25
        )
        hidden_first = np.concatenate(
            [points[:1] * np.float32([1.5, 1.5, 1.5, 1]), points]
        )
        scan.set_points(hidden_first[:, :3].copy(), hidden_first[:, 3].copy())
        channels = [
            scan.proj_range[None],
            scan.proj_xyz.transpose(2, 0, 1),
            scan.proj_remission[None],
        ]
        mask = torch.from_numpy(scan.proj_mask).float()
        return of_image(
            ((torch.from_numpy(np.concatenate(channels)) - mean) / std * mask)[None]
        )

    return Peer(features, of_image)


def _squeezeseg(clones: Path, archive: Path) -> Peer:
    """The pooling is this package's."""
    return _bonnetal(
        clones,
        archive,
        "squeezeseg",
        lambda maps, image: maps[0][:, image[0].abs().sum(0) > 0].mean(1),
    )


def _rangenet21(clones: Path, archive: Path) -> Peer:
    """The pooling is R2Flow's, which it has of LiDARGen."""
    sys.path.insert(0, str(clones / "r2flow"))
    from r2flow.metrics.models import rangenet

    pool = rangenet.PostProcess()
    return _bonnetal(
        clones, archive, "darknet", lambda maps, image: pool(maps, "subsample")[0]
    )


def peers(clones: Path) -> dict[str, tuple[Callable[[Path], Peer], str]]:
    """The peer's code and the preparation for each comparison: {"extractor" or "extractor as
    preparation": ...}."""
    r2flow = R2Flow(clones)
    lidm = LiDM(clones)
    r3dpa = R3DPA(clones)
    return {
        "rangenet53": (lambda a: r2flow.rangenet(a, "subsample", 5), "r2flow"),
        "r2flow_rangenet": (lambda a: r2flow.rangenet(a, "depth", 4), "r2flow"),
        "rangenet21": (lambda a: _rangenet21(clones, a), "bonnetal"),
        "squeezeseg": (lambda a: _squeezeseg(clones, a), "bonnetal"),
        "sparenet_pointnet": (r2flow.pointnet, "r2flow"),
        "lidm_rangenet": (lidm.rangenet, "lidm"),
        "lidm_minkowski": (lambda a: lidm.voxels(a, "minkowskinet"), "lidm"),
        "lidm_spvcnn": (lambda a: lidm.voxels(a, "spvcnn"), "lidm"),
        "lidm_minkowski as r2flow": (
            lambda a: r2flow.voxels(a, "minkowskinet", "MinkowskiNet"),
            "r2flow",
        ),
        "lidm_spvcnn as r2flow": (
            lambda a: r2flow.voxels(a, "spvcnn", "SPVCNN"),
            "r2flow",
        ),
        "r3dpa_rangevit": (lambda a: r3dpa.network(a, "rangevit"), "r3dpa"),
        "r3dpa_rangevit_remission": (lambda a: r3dpa.network(a, "rangevit"), "r3dpa"),
        "liploc": (lambda a: r3dpa.network(a, "liploc"), "r3dpa"),
    }


def read(path: Path) -> Points:
    """(N, 4) the points of a scan, without those whose place in an image depends on rounding or on
    the sort in the peers' code: points that lie in one cell at one range with an earlier point, and
    points at the edge of a cell."""
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    cells = locate(points[:, :3].copy(), presets()["hdl64e_kitti360"])
    _, first = np.unique(
        np.column_stack([cells.cell, cells.range.view(np.int32)]),
        axis=0,
        return_index=True,
    )
    points = points[np.sort(first)]
    x, y, z = points[:, :3].T.astype(np.float64)
    column = (1 - np.arctan2(y, x) / np.pi) / 2 * 2048
    row = (3 - np.degrees(np.arcsin(z / np.sqrt(x**2 + y**2 + z**2)))) / 28 * 64
    inside = np.logical_and.reduce(
        [abs(v - np.round(v)) > 0.002 for v in (column, row)]
    )
    return points[inside]


def compare(clones: Path, files: list[Path], only: list[str]) -> None:
    """Print the table."""
    print(
        "| extractor | prepared as | features | largest difference | Frechet distance: ours | the "
        "peer's |"
    )
    print("|---|---|---:|---:|---:|---:|")
    frechet = peers_frechet(clones)
    for key, (make, preparation) in peers(clones).items():
        name = key.split(" ")[0]
        if only and name not in only:
            continue
        with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
            archive = write(name, Path(folder) / EXTRACTORS[name].archives[0])
            ours = load_extractor(name, archive, preparation)
            theirs = make(archive)
            rows: list[list[NDArray[Any]]] = [[], []]
            for file in files:
                points = read(file)
                scan = Scan(
                    points[:, :3].copy(),
                    points[:, 3].copy(),
                    presets()["hdl64e_kitti360"],
                    id=file.stem,
                )
                rows[0].append(ours([scan])[0])
                rows[1].append(np.asarray(theirs.features(points)))
        a = np.stack(rows[0])
        b = np.stack(rows[1])
        error = abs(a - b).max() / abs(b).max()
        half = len(files) // 2
        distances = ["", ""]
        if half > 2:
            ours = reduced(a, half - 1)
            theirs = reduced(b, half - 1)
            distances = [
                f"{v:.6g}"
                for v in (
                    frechet_distance(ours[:half], ours[half:]),
                    frechet(theirs, half),
                )
            ]
        print(
            f"| {name} | {preparation} | {a.shape[1]} | {error:.1e} | {distances[0]} | "
            f"{distances[1]} |",
            flush=True,
        )


def peers_frechet(clones: Path) -> Callable[[NDArray[np.float64], int], float]:
    """LiDM's Fréchet distance between the first samples, by their number, and the others."""
    path = clones / "LiDAR-Diffusion" / "lidm" / "eval" / "fid_score.py"
    env = {"np": np, "linalg": __import__("scipy.linalg").linalg}
    code = _functions(path, ("calculate_frechet_distance",), env)

    def distance(x: NDArray[np.float64], first: int) -> float:
        moments = [
            m
            for part in (x[:first], x[first:])
            for m in (part.mean(0), np.cov(part, rowvar=False))
        ]
        return float(code.calculate_frechet_distance(*moments))

    return distance


def golden(clones: Path, path: Path) -> None:
    """Write what the peers' networks make of random images or points, their Fréchet distances
    between two sets of them, and their images of the points."""
    from safetensors.numpy import save_file

    points = random_points()
    frechet = peers_frechet(clones)
    found: dict[str, Any] = {"points": points}
    makers = {"r2flow": R2Flow(clones), "lidm": LiDM(clones)}
    for name, maker in makers.items():
        image = np.asarray(maker.image(points), np.float32).reshape(-1, 64, 1024)
        filled = image[0] > 0
        found[f"{name} image"] = np.ascontiguousarray(image[:, filled])
        found[f"{name} cells"] = np.flatnonzero(filled).astype(np.int32)
    for key, (make, _) in peers(clones).items():
        name = key.split(" ")[0]
        with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
            peer = make(write(name, Path(folder) / EXTRACTORS[name].archives[0]))
            channels = 4 if name in ("lidm_rangenet", "r2flow_rangenet") else 5

            def of(
                seed: int, scale: float, peer: Peer = peer, channels: int = channels
            ) -> NDArray[np.floating]:
                if peer.of_image:
                    return np.asarray(
                        peer.of_image(random_image(channels, seed, scale))
                    )
                return np.asarray(peer.features(random_points(1000, seed, scale)))

            features = (
                peer.of_image(random_image(channels))
                if peer.of_image
                else peer.features(points)
            )
            found[key] = np.ascontiguousarray(features, np.float32)
            both = reduced(np.stack([of(*one) for one in two_sets()]))
            found[f"{key} distance"] = np.array([frechet(both, PER_SET)])
    save_file(found, path)


def main() -> None:
    """Parse the arguments."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("clones", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", default=[], choices=list(WRITERS))
    parser.add_argument("--scans", type=int, default=4)
    parser.add_argument("--golden", type=Path)
    given = parser.parse_args()
    if given.golden:
        golden(given.clones, given.golden)
    else:
        compare(
            given.clones, sorted(given.folder.rglob("*.bin"))[: given.scans], given.only
        )


if __name__ == "__main__":
    main()

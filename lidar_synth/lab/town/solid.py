"""Ray casting against triangles with Embree (PyPI ``embreex``), which only this module imports."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar_synth.errors import LibraryError
from lidar_synth.geometry.arrays import Float32Array


def load_embree() -> tuple[Any, Any]:
    """Embree's scene and triangle mesh classes.

    Raises:
        LibraryError: if embreex is missing.
    """
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise LibraryError(
            f"the town needs embreex, which cannot be imported ({error})",
            "embreex 2.17 or later; PyPI has no wheel for Linux on aarch64",
            "Type 'pip install embreex', or read a town that was exported on another machine: "
            "only the town needs it.",
        ) from error
    return EmbreeScene, TriangleMesh


class Solid:
    """Triangles as an Embree scene.

    Args:
        triangles: (F, 3, 3) float32 metres.

    Raises:
        LibraryError: if embreex is missing.
    """

    def __init__(self, triangles: Float32Array) -> None:
        scene, mesh = load_embree()
        self._triangles = np.ascontiguousarray(triangles, np.float32)
        self._scene = scene()
        self._mesh = mesh(self._scene, self._triangles)

    def __reduce__(self) -> tuple[type["Solid"], tuple[Float32Array]]:
        return Solid, (self._triangles,)

    def first(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Float32Array, NDArray[np.int32], Float32Array]:
        """Distance (inf = no hit), triangle (-1 = no hit) and normal (not unit) of the first hit of
        each ray."""
        out = self._scene.run(
            np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=1
        )
        face: NDArray[np.int32] = out["primID"]
        distance: Float32Array = out["tfar"]
        distance[face < 0] = np.inf
        return distance, face, out["Ng"]

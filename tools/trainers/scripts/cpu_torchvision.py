"""torchvision from the package index beside a torch without CUDA, with which its compiled operators
cannot load."""

import torch


def import_torchvision() -> None:
    """Import torchvision; declare the operators that its import needs, if they could not be
    loaded."""
    try:
        import torchvision
    except RuntimeError:
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            library.define(
                f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
            )
        _declared.append(library)  # its operators live as long as it does
        import torchvision  # noqa: F401


_declared: list[torch.library.Library] = []

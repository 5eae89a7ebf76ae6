"""The card of a model on the Hugging Face hub."""

from lidar_synth.datasets.recordings import seen_by
from lidar_synth.files.hub import front_matter
from lidar_synth.files.markdown import escape_markdown, list_facts
from lidar_synth.generate.checkpoint import Header

TASKS = {"semantic": "image-to-3d", "camera": "image-to-3d", "layout": "other"}
"""{condition: the hub's category of the task}; without one, "unconditional-image-generation"."""


def model_card(
    place: str, header: Header, digest: str, parameters: int, licence: str | None
) -> str:
    """The card: Markdown with the hub's metadata as a header.

    Args:
        place: where the model will be, ``hf://user/model``.
        header: the header of its checkpoint.
        digest: the hash of its checkpoint.
        parameters: number of the model's parameters.
        licence: an identifier of the hub; None = the licence of the header.
    """
    provenance = header.provenance
    condition = next(iter(header.conditioning), None)
    rows, columns = header.sensor.shape
    name = place.rpartition("/")[2]
    facts = {
        "sensor": f"{header.sensor.name}, {rows} x {columns}",
        "channels": ", ".join(header.channels),
        "condition": condition or "none",
        "steps": len(header.time_grid) - 1,
        "parameters": f"{parameters / 1e6:.1f} M",
        "licence": licence or provenance["licence"],
        "data": provenance["data"],
        "data licence": provenance["data_licence"],
        "recordings": seen_by(provenance) or "none known",
        "checkpoint": digest,
    }
    lines = [
        *front_matter(
            [licence or str(provenance["licence"])],
            library_name="lidar_synth",
            pipeline_tag=TASKS.get(str(condition), "unconditional-image-generation"),
            tags=["lidar", "point-cloud", "range-image"],
        ),
        f"# {escape_markdown(name)}",
        "",
        "A generative model of LiDAR scans.",
        "",
        "```python",
        "from lidar_synth import load_generator",
        "",
        f'generator = load_generator("{place}")',
        "```",
        "",
        *list_facts(facts),
    ]
    return "\n".join(lines) + "\n"

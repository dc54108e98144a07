"""The layout of a Rerun file as the viewer reads it."""

from collections import defaultdict
from pathlib import Path

from rerun.chunk import RrdReader


def parents_of_views(path: Path) -> dict[str, list[str]]:
    """The containers in which each view of the file's blueprint stands, by the view's entity; one
    each, or it is refused.
    """
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    views, parents = [], defaultdict(list)
    for chunk in reader.stream(store=blueprint).to_chunks():
        batch = chunk.to_record_batch()
        if "ViewBlueprint:space_origin" in batch.schema.names:
            views.append(chunk.entity_path)
        if "ContainerBlueprint:contents" in batch.schema.names:
            for child in batch.column("ContainerBlueprint:contents").to_pylist()[0]:
                parents[f"/{child}"].append(chunk.entity_path)
    return {view: parents[view] for view in views}


def has_one_parent_each(path: Path) -> bool:
    """Whether the file has views, and each stands in one container."""
    found = parents_of_views(path)
    return len(found) > 0 and all(len(parents) == 1 for parents in found.values())

"""The layout of a Rerun file as the viewer reads it."""

from collections import defaultdict
from pathlib import Path

import numpy as np
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


def opening_screen(path: Path) -> dict[str, np.ndarray]:
    """Left, top, width and height of each view of the first tab, as shares of the screen."""
    reader, parts, origins = RrdReader(path), {}, {}
    (blueprint,) = reader.blueprints()
    for chunk in reader.stream(store=blueprint).to_chunks():
        batch = chunk.to_record_batch()
        values = {
            name.split(":")[-1]: batch.column(name).to_pylist()[0]
            for name in batch.schema.names
            if name.startswith(("ContainerBlueprint:", "ViewBlueprint:"))
        }
        parts |= {chunk.entity_path[1:]: values} if "container_kind" in values else {}
        origins |= (
            {chunk.entity_path[1:]: values["space_origin"][0]} if "space_origin" in values else {}
        )
    inside = {child for values in parts.values() for child in values["contents"]}
    (root,) = parts.keys() - inside

    def placed(name: str, at: np.ndarray) -> dict[str, np.ndarray]:
        if name in origins:
            return {"/" + origins[name].strip("/").replace("\\", ""): at}
        values = parts[name]
        children, (kind,) = values["contents"], values["container_kind"]
        if kind == 1:  # tabs
            return placed(values.get("active_tab", children)[0], at)
        columns = {2: len(children), 3: 1}.get(kind) or values["grid_columns"][0]
        rows = -(-len(children) // columns)
        widths = np.array(values.get("col_shares") or [1.0] * columns)
        heights = np.array(values.get("row_shares") or [1.0] * rows)
        lefts, tops = (np.r_[0, np.cumsum(x)] / x.sum() for x in (widths, heights))
        views = {}
        for k, child in enumerate(children):
            row, column = divmod(k, columns)
            share = [lefts[column], tops[row], np.diff(lefts)[column], np.diff(tops)[row]]
            views |= placed(child, np.r_[at[:2] + at[2:] * share[:2], at[2:] * share[2:]])
        return views

    return placed(root, np.array([0.0, 0.0, 1.0, 1.0]))

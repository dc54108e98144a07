"""Mesh files that a URDF names."""

import os
import xml.etree.ElementTree as ET
from pathlib import Path

from ..errors import Location

MESHES = (".stl", ".obj", ".dae", ".glb", ".gltf")  # formats that viewers read
MAX_MESH_BYTES = 64 * 2**20  # of all meshes of a robot together


def read_meshes(urdf: bytes, folder: Path, place: str) -> dict[str, bytes]:
    """Read the meshes of a URDF's visual shapes, by name.

    Parameters
    ----------
    urdf : content of the URDF.
    folder : folder of the URDF.
    place : name of the description in errors.

    Raises
    ------
    BadInputError : a mesh is missing, or all of them exceed `MAX_MESH_BYTES`.
    """
    at = Location(place)
    try:
        visuals = ET.fromstring(urdf).iter("visual")
    # An unknown encoding raises ValueError or LookupError.
    except (ET.ParseError, ValueError, LookupError) as error:
        at.refuse("urdf", text=f"the file is not valid XML: {error}")
    meshes, size = dict[str, bytes](), 0
    for name in dict.fromkeys(
        mesh.get("filename", "") for visual in visuals for mesh in visual.iter("mesh")
    ):
        file = at.given(
            find_mesh(name, folder),
            "urdf: mesh",
            name,
            text="the file does not exist, or has another format",
            advice=f"Put it beside the URDF or in a ROS package, as {', '.join(MESHES)}",
        )
        try:
            size += file.stat().st_size
            at.require(
                size <= MAX_MESH_BYTES,
                "urdf: mesh",
                name,
                text=f"with it the meshes have {size} bytes, more than {MAX_MESH_BYTES}",
                advice="Remove urdf_meshes",
            )
            meshes[name] = file.read_bytes()
        except OSError as error:
            at.refuse("urdf: mesh", name, text=f"the file cannot be read: {error.strerror}")
    return meshes


def find_mesh(name: str, folder: Path | None = None) -> Path | None:
    """Find the mesh file that a URDF names; None if it does not exist or has an unknown format.

    A name is a path, absolute or relative to the `folder` of the URDF, or `package://PACKAGE/REST`.
    Packages are searched in the folder of the URDF, in the folders above it, and in
    `ROS_PACKAGE_PATH` and `AMENT_PREFIX_PATH`.
    """
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        sources, installed = (
            [
                Path(path).resolve()
                for path in os.environ.get(variable, "").split(os.pathsep)
                if path
            ]
            for variable in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
        )
        near = [] if folder is None else [folder.resolve(), *folder.resolve().parents]
        files = [
            *((x if x.name == package else x / package) / rest for x in (*near, *sources)),
            *(x / "share" / package / rest for x in installed),
        ]
    else:
        path = Path(name.removeprefix("file://"))
        files = [path if folder is None else folder.resolve() / path]
    return next(
        (f for f in files if f.is_absolute() and f.suffix.lower() in MESHES and f.is_file()), None
    )

"""Points and triangles as PLY files, binary, as Blender, MeshLab and CloudCompare open them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from ctm_plugin.files import replacing

VERTEX_TYPE = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in ("red", "green", "blue")]
)
"""Binary layout of a vertex and of a face."""
FACE_TYPE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def write_ply(
    path: Path,
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"],
    colors: UInt8[np.ndarray, "p 3"],
    faces: Int[np.ndarray, "f 3"] | None = None,
) -> None:
    """Write vertices with normals and colours, whole or not at all.

    Args:
        path: the file to write.
        points, normals: in any unit; normals of unit length.
        colors: sRGB of the vertices.
        faces: triples of vertices, counter-clockwise from outside; ``None``: a cloud of points.
    """
    vertices = np.empty(len(points), VERTEX_TYPE)
    for names, values in ((("x", "y", "z"), points), (("nx", "ny", "nz"), normals), (("red", "green", "blue"), colors)):
        for name, column in zip(names, values.T, strict=True):
            vertices[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [f"property {kinds[VERTEX_TYPE[name].str]} {name}" for name in VERTEX_TYPE.names]
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    body = vertices.tobytes()
    if faces is not None:
        triangles = np.empty(len(faces), FACE_TYPE)
        triangles["count"], triangles["corners"] = 3, faces
        body += triangles.tobytes()
    with replacing(path) as beside:
        beside.write_bytes("\n".join([*head, "end_header\n"]).encode() + body)

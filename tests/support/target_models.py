"""Meshes of targets that tests make."""

import numpy as np

# A box 1 m long, 0.4 m wide and 0.6 m high, as a file of triangles; x is forward.
CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.2, 0.2) for z in (-0.3, 0.3)])
FACES = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]


def mesh(corners, faces):
    """An .obj file."""
    return "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {' '.join(map(str, f))}\n" for f in faces)


BOX = mesh(CORNERS, FACES)

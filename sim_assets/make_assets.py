"""Draw every texture and mesh of the simulation: ``python sim_assets/make_assets.py`` writes the same files every time.

Textures are PNG, at most 1024 px a side. Meshes are OBJ with texture coordinates and smooth normals, in metres and in
the frame of the body that carries them.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

HERE = Path(__file__).parent
TEXTURES = HERE / "textures"
MESHES = HERE / "meshes"

Array = npt.NDArray[np.float64]
Color = tuple[int, int, int]  # (red, green, blue); reversed where OpenCV wants it

BOOK_MARKER, PERSON_MARKER, BIRD_MARKER = 1, 2, 3  # ids in DICT_4X4_50
MARKER_CELLS = 6  # of a 4x4 marker with its black border
FURTHER_MARKERS = (10, 20, 30, 40)  # added to the ids for the second to the fifth person or bird


# ---------------------------------------------------------------- textures


def noise(rng: np.random.Generator, size: int, scale: float, octaves: int = 4, stretch: float = 1.0) -> Array:
    """Make tileable cloud noise with zero mean and unit deviation, (size, size).

    Args:
        rng: source of randomness.
        size: side [px].
        scale: size of the coarsest blobs [px].
        octaves: number of ever finer layers, each half as strong as the one before.
        stretch: above 1 for blobs drawn out along the rows.
    """
    fy = np.fft.fftfreq(size)[:, None]
    fx = np.fft.fftfreq(size)[None, :] * stretch
    total = np.zeros((size, size))
    for octave in range(octaves):
        sigma = scale / 2**octave / 4
        blur = np.exp(-2 * (np.pi * sigma) ** 2 * (fx**2 + fy**2))
        layer = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) * blur).real
        total += layer / layer.std() / 2**octave
    return (total - total.mean()) / total.std()


def tint(color: Color, shade: Array) -> Array:
    """Shade a colour by a factor a pixel, (H, W, 3) BGR float."""
    return np.array(color[::-1], dtype=float) * shade[..., None]


def save(name: str, image: Array) -> None:
    """Write one texture."""
    cv2.imwrite(str(TEXTURES / f"{name}.png"), np.clip(np.round(image), 0, 255).astype(np.uint8))


def marker_image(marker: int, cell: int, quiet: float) -> npt.NDArray[np.uint8]:
    """Draw an ArUco marker, ``cell`` px a cell, in a white margin ``quiet`` cells wide."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    black = cv2.aruco.generateImageMarker(dictionary, marker, MARKER_CELLS * cell)
    margin = round(quiet * cell)
    return cv2.copyMakeBorder(black, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)


def draw_markers() -> None:
    """Markers of the person and the bird.

    Off-white, so that lit paper does not saturate; the bird's are grey, so that it stays as dark as its plumage.
    """
    for name, marker, quiet, light in (("person", PERSON_MARKER, 1.0, 222), ("bird", BIRD_MARKER, 0.75, 140)):
        for more in (0, *FURTHER_MARKERS):
            image = marker_image(marker + more, 40, quiet).astype(float)
            file = f"{name}_marker_{marker + more}" if more else f"{name}_marker"
            save(file, np.repeat((18 + image * (light / 255))[..., None], 3, axis=2))


BOOK_RED: Color = (196, 22, 34)


def draw_book() -> None:
    """Front and back cover and the block of pages of the book."""
    rng = np.random.default_rng(1)
    width, height = 936, 680  # 4 px a millimetre of 234 x 170 mm
    linen = cv2.resize(noise(rng, 512, 6, 2) * 0.02 + noise(rng, 512, 160, 2) * 0.025, (width, height))
    cover = np.clip(tint(BOOK_RED, 1 + linen), 0, 255).astype(np.uint8)  # text is drawn on bytes only
    cream, gold = (214, 232, 240), (96, 176, 222)
    for inset, thick in ((22, 5), (34, 2)):
        cv2.rectangle(cover, (inset, inset), (width - inset, height - inset), gold, thick, cv2.LINE_AA)
    back = cover.copy()
    font, thin = cv2.FONT_HERSHEY_COMPLEX, cv2.LINE_AA
    cv2.putText(cover, "Two Cameras", (70, 150), font, 2.5, cream, 7, thin)
    cv2.line(cover, (72, 200), (480, 200), gold, 4, thin)
    cv2.putText(cover, "near and far", (72, 268), cv2.FONT_HERSHEY_COMPLEX, 1.5, cream, 4, thin)
    for i, radius in enumerate((118, 84, 52, 22)):  # a lens
        cv2.circle(cover, (240, 468), radius, gold if i % 2 == 0 else cream, 5, thin)
    marker = marker_image(BOOK_MARKER, 48, 0.75)
    top, left = height - 56 - marker.shape[0], width - 60 - marker.shape[1]
    cover[top : top + marker.shape[0], left : left + marker.shape[1]] = (14 + marker * (222 / 255))[..., None]
    save("book_front", cover)
    cv2.line(back, (width // 2 - 130, height // 2), (width // 2 + 130, height // 2), gold, 4, thin)
    save("book_back", back)
    lines = 1 + 0.05 * np.repeat(rng.standard_normal((1, 64)), 64, axis=0)
    save("book_pages", tint((236, 228, 206), lines))


def draw_person() -> None:
    """Cloth, trousers, skin with a face, and hair. The face is centred on u = 0.5, that is forward."""
    rng = np.random.default_rng(2)
    size = 512
    folds = noise(rng, size, 120, 3, stretch=0.6) * 0.05 + noise(rng, size, 5, 2) * 0.03
    jacket = tint((34, 84, 172), 1 + folds)
    yoke = size // 4
    jacket[:yoke] = tint((22, 48, 104), 1 + folds)[:yoke]
    jacket[yoke : yoke + 7] = (205, 214, 218)
    jacket[-26:] *= 0.72  # the hem
    jacket[:, size // 2 - 4 : size // 2 + 4] *= 0.55  # the zip
    save("person_jacket", jacket)
    sleeve = tint((34, 84, 172), 1 + folds)
    sleeve[-30:] *= 0.7
    save("person_sleeve", sleeve)
    denim = 1 + noise(rng, size, 160, 3, stretch=0.5) * 0.06 + noise(rng, size, 3, 1) * 0.06
    save("person_trousers", tint((58, 56, 62), denim)[::2, ::2])
    face = tint((222, 172, 142), 1 + noise(rng, size, 150, 3) * 0.02)
    for u in (0.5 - 0.062, 0.5 + 0.062):
        x, y = round(u * size), round(0.47 * size)
        cv2.ellipse(face, (x, y), (17, 8), 0, 0, 360, (236, 240, 240), -1, cv2.LINE_AA)
        cv2.circle(face, (x, y), 7, (52, 44, 40), -1, cv2.LINE_AA)
        cv2.ellipse(face, (x, y - 22), (24, 6), 0, 180, 360, (40, 54, 72), 5, cv2.LINE_AA)
    cv2.ellipse(face, (size // 2, round(0.70 * size)), (30, 9), 0, 0, 180, (96, 92, 176), 6, cv2.LINE_AA)
    save("person_face", face)
    strands = noise(rng, 256, 24, 3, stretch=0.15) * 0.16
    save("person_hair", tint((66, 44, 30), 1 + strands))
    save("person_bag", tint((26, 92, 92), 1 + noise(rng, 256, 6, 2) * 0.05))


def draw_bird() -> None:
    """Plumage of the trunk and of the wings, feathers along the chord."""
    rng = np.random.default_rng(3)
    size = 512
    mottle = 1 + 0.10 * noise(rng, size, 30, 3, stretch=0.5)
    save("bird_trunk", tint((52, 50, 56), mottle)[::2, ::2])
    rows, columns = np.mgrid[0:size, 0:size] / size
    wing = np.ones((size, size))
    for first, last, count in ((0.0, 0.30, 26), (0.26, 0.55, 20), (0.50, 1.0, 14)):
        inside = (rows >= first) & (rows <= last)
        phase = (columns * count) % 1
        edge = np.exp(-(((phase - 0.95) / 0.10) ** 2))
        scallop = np.exp(-(((rows - last + 0.05 * np.abs(phase - 0.5)) / 0.02) ** 2))
        feather = 1.06 - 0.4 * edge + 0.16 * (phase - 0.5) - 0.35 * scallop
        wing = np.where(inside, feather, wing)
    shade = wing * (1.10 - 0.42 * rows) * mottle**0.4
    image = tint((74, 70, 76), shade)
    image[rows > 0.88] *= 0.6
    save("bird_wing", image)


def planks(rng: np.random.Generator, size: int, rows: int, color: Color, contrast: float) -> Array:
    """Draw a floor of boards along x."""
    image = np.empty((size, size, 3))
    grain = noise(rng, size, 90, 5, stretch=0.06)
    for i in range(rows):
        top, bottom = i * size // rows, (i + 1) * size // rows
        joints = np.sort((rng.uniform(0.1, 0.4) + np.array([0.0, 0.5])) * size).astype(int)
        ends = [0, *joints, size]
        tones = 1 + contrast * rng.standard_normal(len(joints) + 1)
        tones[-1] = tones[0]  # so that it tiles
        for left, right, tone in zip(ends[:-1], ends[1:], tones, strict=True):
            shift = int(rng.integers(size))
            board = np.roll(grain, shift, axis=1)[top:bottom, left:right]
            image[top:bottom, left:right] = tint(color, tone + 0.045 * board)
        image[top : top + 2] *= 0.62
        for joint in joints:
            image[top:bottom, joint : joint + 2] *= 0.62
    return image


def draw_indoor() -> None:
    """Floor, plaster, pictures, books on a shelf, a window and a rug; no saturated red anywhere."""
    rng = np.random.default_rng(4)
    save("indoor_floor", planks(rng, 1024, 12, (158, 146, 128), 0.06))
    plaster = noise(rng, 1024, 300, 3) * 0.008 + noise(rng, 1024, 6, 2) * 0.010
    v, u = np.mgrid[0:1024, 0:1024] / 1023.0
    corner = np.minimum(u, 1 - u)
    glow = 1 - 0.16 * np.exp(-corner / 0.05) - 0.14 * np.exp(-v / 0.07) - 0.12 * np.exp(-(1 - v) / 0.08)
    save("indoor_far_wall", tint((216, 212, 200), glow * (1.0 + plaster)))
    glow = 1 - 0.12 * np.exp(-v / 0.08) - 0.12 * np.exp(-(1 - v) / 0.1)
    save("indoor_side_wall", tint((204, 206, 200), glow * (1.0 + plaster)))
    tile = np.ones((512, 512)) + 0.012 * noise(rng, 512, 4, 2)
    tile[:5] = tile[:, :5] = 0.82
    save("indoor_ceiling", tint((226, 226, 222), tile))
    wood = 1 + 0.07 * noise(rng, 512, 80, 4, stretch=0.05)
    save("indoor_wood", tint((176, 152, 116), wood))
    draw_pictures(rng)
    draw_shelf(rng)
    draw_window(rng)
    weave = 1 + 0.05 * noise(rng, 512, 3, 1)
    rug = tint((74, 96, 112), weave)
    for inset, color in ((20, (190, 186, 168)), (44, (52, 70, 88)), (60, (150, 160, 150))):
        cv2.rectangle(rug, (inset, inset), (511 - inset, 511 - inset), color[::-1], 8)
    for x in range(110, 420, 48):
        for y in range(110, 420, 48):
            diamond = np.array([[x, y - 16], [x + 16, y], [x, y + 16], [x - 16, y]])
            cv2.fillPoly(rug, [diamond], (168, 176, 178) if (x + y) // 48 % 2 else (128, 104, 72), cv2.LINE_AA)
    save("indoor_rug", rug * weave[..., None])


def draw_pictures(rng: np.random.Generator) -> None:
    """Three quiet paintings: mountains, the sea, and leaves."""
    height, width = 384, 512
    v = np.linspace(0, 1, height)[:, None]
    x = np.arange(width)
    sky = np.array([222, 206, 170.0]) * (1 - v[..., None]) + np.array([196, 216, 232.0]) * v[..., None]
    mountains = np.broadcast_to(sky, (height, width, 3)).copy()
    for level, color in zip(
        (0.42, 0.56, 0.7, 0.84), ((176, 156, 140), (140, 122, 96), (104, 96, 60), (66, 70, 44)), strict=True
    ):
        ridge = level * height + 26 * np.interp(x, np.linspace(0, width, 12), rng.standard_normal(12)) * (1.1 - level)
        mountains[np.arange(height)[:, None] > ridge[None, :]] = color
    save("indoor_picture_a", cv2.GaussianBlur(mountains, (0, 0), 1.2))
    waves = cv2.resize(noise(rng, 512, 60, 4, stretch=0.15), (width, height))
    sea = np.where(v[..., None] < 0.45, np.array([226, 208, 188.0]), np.array([150, 116, 48.0]))
    sea = sea * (1 + np.where(v < 0.45, 0.02, 0.16) * waves)[..., None]
    cv2.circle(sea, (370, 90), 34, (190, 232, 244), -1, cv2.LINE_AA)
    save("indoor_picture_b", sea)
    leaves = np.full((512, 384, 3), (214, 226, 226.0))
    for _ in range(46):
        center = (int(rng.integers(40, 344)), int(rng.integers(40, 472)))
        shade = rng.uniform(0.6, 1.1)
        color = tuple(float(c * shade) for c in ((96, 140, 84), (70, 120, 120), (120, 132, 60))[int(rng.integers(3))])
        cv2.ellipse(leaves, center, (44, 15), float(rng.uniform(0, 360)), 0, 360, color, -1, cv2.LINE_AA)
    save("indoor_picture_c", leaves)


def draw_shelf(rng: np.random.Generator) -> None:
    """A bookcase's front: boards, and rows of muted books."""
    height, width = 1024, 768
    image = np.full((height, width, 3), (60, 68, 74.0))
    spines = [
        (92, 104, 120),
        (70, 92, 84),
        (150, 140, 110),
        (176, 170, 154),
        (58, 66, 88),
        (112, 124, 104),
        (134, 128, 136),
    ]
    board, shelves = 18, 5
    pitch = (height - board) // shelves
    for i in range(shelves):
        floor = (i + 1) * pitch
        x = board + 4
        while x < width - board - 40:
            wide, tall = int(rng.integers(14, 38)), int(rng.integers(int(0.55 * pitch), int(0.86 * pitch)))
            if rng.random() < 0.12:
                x += int(rng.integers(30, 110))
                continue
            if x + wide > width - board:
                break
            color = np.array(spines[int(rng.integers(len(spines)))][::-1]) * rng.uniform(0.75, 1.1)
            image[floor - tall : floor, x : x + wide] = color
            image[floor - tall : floor, x : x + 3] *= 1.12
            image[floor - tall : floor, x + wide - 4 : x + wide] *= 0.7
            band = floor - int(0.75 * tall)
            image[band : band + 8, x + 4 : x + wide - 4] = (190, 206, 208)
            x += wide
    wood = cv2.resize(1 + 0.06 * noise(rng, 512, 80, 4, stretch=0.05), (width, height))
    frame = np.zeros((height, width), bool)
    for i in range(shelves + 1):
        frame[i * pitch : i * pitch + board] = True
    frame[:, :board] = frame[:, -board:] = True
    image[frame] = tint((170, 148, 114), wood)[frame]
    save("indoor_shelf", image)


def draw_window(rng: np.random.Generator) -> None:
    """Daylight behind panes."""
    size = 512
    v = np.linspace(0, 1, size)[:, None, None]
    image = np.broadcast_to(
        np.array([246, 234, 216.0]) * (1 - v) + np.array([238, 242, 238.0]) * v, (size, size, 3)
    ).copy()
    trees = 0.62 * size + 26 * np.interp(np.arange(size), np.linspace(0, size, 24), rng.standard_normal(24))
    image[np.arange(size)[:, None] > trees[None, :]] = (150, 182, 160)
    image = cv2.GaussianBlur(image, (0, 0), 5)
    for at in (0, size // 2, size):
        low, high = max(at - 12, 0), min(at + 12, size)
        image[low:high] = image[:, low:high] = (232, 234, 234)
    save("indoor_window", image)


def draw_outdoor() -> None:
    """Grass, leaves, needles, bark, house fronts, roof and hills."""
    rng = np.random.default_rng(5)
    size = 1024
    patches, blades = noise(rng, size, 500, 3), noise(rng, size, 14, 4)
    grass = tint((104, 128, 58), 1 + 0.07 * patches + 0.13 * blades)
    dry = 1 / (1 + np.exp(-2.5 * (noise(rng, size, 360, 3) - 1.0)))
    grass += dry[..., None] * 0.5 * (tint((150, 144, 84), 1 + 0.10 * blades) - grass)
    save("outdoor_grass", grass)
    clumps, fine = noise(rng, size, 190, 3), noise(rng, size, 34, 4)
    leaf = 1 + 0.13 * clumps + 0.27 * fine
    leaves = tint((86, 112, 54), np.clip(leaf, 0.3, 1.8))
    leaves[..., 2] *= 1 + 0.07 * clumps
    save("outdoor_leaves", leaves)
    needles = 1 + 0.14 * noise(rng, 512, 90, 3) + 0.26 * noise(rng, 512, 14, 2, stretch=2.0)
    save("outdoor_needles", tint((44, 78, 54), needles))
    save("outdoor_bark", tint((98, 82, 66), 1 + 0.22 * noise(rng, 256, 30, 3, stretch=3.0)))
    save("outdoor_hills", tint((112, 134, 124), 1 + 0.07 * noise(rng, 512, 40, 4)))
    save("outdoor_roof", draw_tiles(rng))
    for name, color in (("a", (222, 208, 180)), ("b", (198, 202, 204))):
        save(f"outdoor_house_{name}", draw_front(rng, color))


def draw_tiles(rng: np.random.Generator) -> Array:
    """Roof tiles, brown."""
    size, rows = 512, 16
    v, u = np.mgrid[0:size, 0:size] / size * rows
    row = np.floor(v).astype(int)
    column = np.floor(u + 0.5 * (row % 2)).astype(int) % rows
    tones = 1 + 0.09 * rng.standard_normal((rows, rows))
    return tint((118, 92, 80), tones[row, column] * (0.72 + 0.4 * (v % 1)))


def draw_front(rng: np.random.Generator, color: Color) -> Array:
    """A house front: plaster, two rows of windows, a door."""
    height, width = 512, 768
    grain = cv2.resize(0.02 * noise(rng, 512, 60, 4), (width, height))
    image = tint(color, 1 + grain)
    for y in (70, 290):
        for x in (70, 240, 410, 580):
            if y == 290 and x == 410:
                cv2.rectangle(image, (x, y), (x + 105, height), (60, 74, 84), -1)
                continue
            cv2.rectangle(image, (x - 10, y - 10), (x + 115, y + 150), (232, 234, 234), -1)
            cv2.rectangle(image, (x, y), (x + 105, y + 138), (104, 90, 76), -1)
            cv2.rectangle(image, (x, y), (x + 105, y + 60), (146, 128, 108), -1)
            cv2.line(image, (x + 52, y), (x + 52, y + 138), (232, 234, 234), 6)
    return image


SKY_UP = {  # for each side of the sky's cube: world direction of the image's centre, of its right, of its top
    "front": ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    "right": ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "back": ((0, -1, 0), (-1, 0, 0), (0, 0, 1)),
    "left": ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "up": ((0, 0, 1), (1, 0, 0), (0, -1, 0)),
    "down": ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
}


def draw_sky() -> None:
    """Six sides of a sky: gradient, haze, and clouds on a flat layer far above."""
    rng = np.random.default_rng(6)
    size = 512
    layer = noise(rng, 1024, 420, 6)
    detail = noise(rng, 1024, 60, 4)
    w = (np.arange(size) + 0.5) / size * 2 - 1
    for side, (ahead, right, top) in SKY_UP.items():
        ray = np.asarray(ahead) + w[None, :, None] * np.asarray(right) - w[:, None, None] * np.asarray(top)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        up = np.clip(ray[..., 2], 0, 1)
        zenith, horizon = np.array([196, 138, 78.0]), np.array([236, 222, 204.0])
        blend = (1 - np.exp(-3.2 * up))[..., None]
        image = horizon * (1 - blend) + zenith * blend
        # The layer is curved like the Earth's, so that clouds neither shrink to nothing nor repeat at the horizon.
        distance = 1 / (up + 0.22)
        at = [np.mod(ray[..., i] * distance * 250 + 300 + 71 * i, 1024).astype(np.float32) for i in (0, 1)]
        density = cv2.remap(layer, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        density += 0.25 * cv2.remap(detail, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        cover = 1 / (1 + np.exp(-4.5 * (density - 0.75)))
        cover *= np.clip(up / 0.06, 0, 1) * 0.85
        shade = 246 - 16 * np.clip(density - 1.0, 0, 1.5)
        image += cover[..., None] * (shade[..., None] * np.array([1.0, 0.995, 0.985]) - image)
        image[ray[..., 2] < -0.02] = (110, 132, 116)
        save(f"outdoor_sky_{side}", image)


# ---------------------------------------------------------------- meshes


class Mesh:
    """Vertices with texture coordinates, faces, and normals smoothed within each added surface."""

    def __init__(self) -> None:
        self.vertices: list[Array] = []
        self.uvs: list[Array] = []
        self.normals: list[Array] = []
        self.faces: list[npt.NDArray[np.int64]] = []

    def add(self, vertices: Array, uv: Array, faces: Sequence[Sequence[int]], weld: bool = True) -> None:
        """Add one surface; ``weld`` smooths normals over vertices at the same place, as on a seam."""
        triangles = np.array([(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)])
        corner = vertices[triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        triangles, normal = (
            triangles[np.linalg.norm(normal, axis=1) > 1e-12],
            normal[np.linalg.norm(normal, axis=1) > 1e-12],
        )
        if weld:
            _, same = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
            same = same.ravel()
        else:
            same = np.arange(len(vertices))
        sums = np.zeros((same.max() + 1, 3))
        for k in range(3):
            np.add.at(sums, same[triangles[:, k]], normal)
        normals = sums[same]
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self.faces.append(triangles + sum(len(v) for v in self.vertices))
        self.vertices.append(vertices)
        self.uvs.append(uv)
        self.normals.append(normals)

    def save(self, name: str, change: Callable[[Array], Array] | None = None, flip: bool = False) -> None:
        """Write an OBJ, its points and normals passed through a linear ``change``; ``flip`` after a mirroring."""
        vertices, normals = np.concatenate(self.vertices), np.concatenate(self.normals)
        if change is not None:
            vertices, normals = change(vertices), change(normals)
        lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in vertices]
        lines += [f"vt {u:.4f} {v:.4f}" for u, v in np.concatenate(self.uvs)]
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals]
        for face in np.concatenate(self.faces) + 1:
            lines.append("f " + " ".join(f"{i}/{i}/{i}" for i in (face[::-1] if flip else face)))
        (MESHES / f"{name}.obj").write_text("\n".join(lines) + "\n", encoding="ascii")


def loft(sections: Sequence[tuple[float, ...]], sides: int = 16, power: float = 2.0) -> Mesh:
    """Skin a row of superellipses, from the lowest to the highest.

    Args:
        sections: (z, half length in x, half length in y, centre's x, centre's y), the last two may be left out [m].
        sides: corners of a section.
        power: 2 for ellipses, more for rounder boxes.

    Returns:
        A closed mesh; u runs around, 0.5 facing +x, and v from bottom to top.
    """
    angle = np.linspace(-np.pi, np.pi, sides + 1)
    c, s = np.cos(angle), np.sin(angle)
    c, s = np.sign(c) * np.abs(c) ** (2 / power), np.sign(s) * np.abs(s) ** (2 / power)
    rows = []
    for section in sections:
        z, rx, ry, cx, cy = (*section, 0.0, 0.0)[:5]
        rows.append(np.stack([cx + rx * c, cy + ry * s, np.full_like(c, z)], axis=1))
    z = np.array([section[0] for section in sections])
    v = (z - z[0]) / (z[-1] - z[0])
    n = sides + 1
    uv = np.stack([np.tile(np.linspace(0, 1, n), len(rows)), np.repeat(v, n)], axis=1)
    faces = [
        (i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j)
        for i in range(len(rows) - 1)
        for j in range(sides)
    ]
    mesh = Mesh()
    mesh.add(np.concatenate(rows), uv, faces)
    return mesh


def tube(stations: Sequence[tuple[float, ...]], round_low: float, round_high: float) -> list[tuple[float, ...]]:
    """Close a row of sections with round ends that bulge by the given lengths [m]."""
    low, high = stations[0], stations[-1]

    def cap(section: tuple[float, ...], bulge: float) -> list[tuple[float, ...]]:
        z, rx, ry, *center = section
        return [
            (z + bulge * np.sin(a), max(rx * np.cos(a), 1e-4), max(ry * np.cos(a), 1e-4), *center)
            for a in np.radians([30, 60, 90])
        ]

    return [*cap(low, -round_low)[::-1], *stations, *cap(high, round_high)]


def along_x(points: Array) -> Array:
    """Turn a loft along z into one along x: its x becomes z and its y stays."""
    return np.stack([points[:, 2], points[:, 1], -points[:, 0]], axis=1) * np.array([1.0, 1.0, 1.0])


def make_plate() -> None:
    """A unit plate that faces +x, seen upright by who looks at it with z up; the sides take the image's border."""
    mesh = Mesh()
    y, z = np.array([-0.5, 0.5, 0.5, -0.5]), np.array([-0.5, -0.5, 0.5, 0.5])
    uv = np.stack([y + 0.5, z + 0.5], axis=1)
    front = np.stack([np.full(4, 0.5), y, z], axis=1)
    back = front * np.array([-1.0, 1.0, 1.0])
    mesh.add(front, uv, [(0, 1, 2, 3)])
    mesh.add(back, np.full((4, 2), 0.005), [(3, 2, 1, 0)])
    for i in range(4):
        j = (i + 1) % 4
        mesh.add(np.stack([front[i], back[i], back[j], front[j]]), np.full((4, 2), 0.005), [(0, 1, 2, 3)])
    mesh.save("plate")


def make_person() -> None:
    """The person's parts; limbs hang from their joint at the origin."""
    loft(
        tube(
            [
                (-0.010, 0.098, 0.165),
                (0.06, 0.106, 0.172),
                (0.18, 0.098, 0.158),
                (0.30, 0.112, 0.170, 0.004),
                (0.42, 0.118, 0.184, 0.004),
                (0.50, 0.104, 0.186),
                (0.555, 0.080, 0.150),
                (0.590, 0.060, 0.085),
                (0.615, 0.055, 0.062),
            ],
            0.02,
            0.012,
        ),
        24,
        2.3,
    ).save("person_torso")
    loft(tube([(-0.03, 0.052, 0.050), (0.06, 0.050, 0.048)], 0.01, 0.01), 16).save("person_neck")
    # The head's origin is at the height of the ears.
    loft(
        tube(
            [
                (-0.112, 0.042, 0.036, 0.036),
                (-0.085, 0.068, 0.054, 0.024),
                (-0.040, 0.086, 0.068, 0.008),
                (0.010, 0.094, 0.074, 0.0),
                (0.050, 0.092, 0.073, -0.004),
                (0.080, 0.076, 0.060, -0.004),
            ],
            0.010,
            0.028,
        ),
        24,
    ).save("person_head")
    loft(
        tube(
            [
                (-0.060, 0.052, 0.064, -0.048),
                (-0.020, 0.068, 0.077, -0.040),
                (0.020, 0.080, 0.083, -0.026),
                (0.050, 0.098, 0.083, -0.008),
                (0.085, 0.084, 0.069, -0.004),
            ],
            0.012,
            0.032,
        ),
        24,
    ).save("person_hair")
    parts = {
        "person_upper_arm": ([(-0.29, 0.043, 0.040), (-0.14, 0.049, 0.046), (0.0, 0.058, 0.054)], 0.03, 0.048),
        "person_forearm": (
            [(-0.245, 0.033, 0.028), (-0.16, 0.038, 0.035), (-0.04, 0.046, 0.042), (0.0, 0.044, 0.041)],
            0.01,
            0.03,
        ),
        "person_hand": (
            [(-0.150, 0.022, 0.011), (-0.10, 0.036, 0.016), (-0.05, 0.040, 0.019), (0.0, 0.026, 0.020)],
            0.020,
            0.01,
        ),
        "person_thigh": (
            [(-0.43, 0.060, 0.056), (-0.25, 0.076, 0.070), (-0.08, 0.094, 0.084), (0.0, 0.094, 0.082)],
            0.04,
            0.06,
        ),
        "person_shin": (
            [(-0.40, 0.046, 0.044), (-0.30, 0.052, 0.049), (-0.14, 0.066, 0.057), (0.0, 0.060, 0.055)],
            0.02,
            0.03,
        ),
    }
    for name, (stations, low, high) in parts.items():
        loft(tube(stations, low, high), 16).save(name)
    sole = [
        (0.0, 0.128, 0.042, 0.055),
        (0.03, 0.132, 0.046, 0.055),
        (0.055, 0.112, 0.044, 0.040),
        (0.085, 0.068, 0.040, 0.004),
    ]
    loft([(-0.001, 0.12, 0.036, 0.055), *sole, (0.11, 0.050, 0.038, -0.004), (0.112, 0.0001, 0.0001)], 18, 2.4).save(
        "person_shoe"
    )
    side = 0.13
    loft(
        [
            (-0.19, 0.10, side - 0.03),
            (-0.175, 0.126, side),
            (0.0, 0.13, side),
            (0.175, 0.126, side),
            (0.19, 0.10, side - 0.03),
        ],
        24,
        9.0,
    ).save("person_bag")


def wing_panel(stations: Sequence[tuple[float, float, float, float]]) -> Mesh:
    """Skin a wing along +y: stations (y, leading edge's x, trailing edge's x, thickness) [m], v = 1 in front."""
    chord = np.array([0.0, 0.06, 0.22, 0.5, 0.8, 1.0])
    camber = np.array([0.0, 0.55, 1.0, 0.8, 0.35, 0.0])
    y0, y1 = stations[0][0], stations[-1][0]
    tops, bottoms, uvs = [], [], []
    for y, front, rear, thick in stations:
        x = front + (rear - front) * chord
        lift = 0.05 * abs(front - rear) * np.sin(np.pi * chord)
        tops.append(np.stack([x, np.full_like(x, y), lift + thick * camber / 2], axis=1))
        bottoms.append(np.stack([x, np.full_like(x, y), lift - thick * camber / 2], axis=1))
        uvs.append(np.stack([np.full_like(chord, (y - y0) / (y1 - y0)), 1 - chord], axis=1))
    n = len(chord)
    faces = [
        (i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j)
        for i in range(len(stations) - 1)
        for j in range(n - 1)
    ]
    mesh = Mesh()
    mesh.add(np.concatenate(tops), np.concatenate(uvs), faces)
    mesh.add(np.concatenate(bottoms), np.concatenate(uvs), [f[::-1] for f in faces])
    return mesh


def make_bird() -> None:
    """The bird's parts; wings start at their hinge. Flanks are flat so that a marker lies on them."""
    stations = [
        (-0.175, 0.020, 0.028, -0.018),
        (-0.14, 0.042, 0.042, -0.010),
        (-0.09, 0.066, 0.058, 0.0),
        (-0.02, 0.078, 0.068, 0.002),
        (0.05, 0.074, 0.064, 0.0),
        (0.10, 0.056, 0.050, -0.010),
        (0.14, 0.036, 0.034, -0.020),
    ]
    loft(tube(stations, 0.012, 0.03), 20, 2.8).save("bird_trunk", along_x)
    loft(tube([(-0.02, 0.036, 0.033), (0.02, 0.044, 0.038), (0.045, 0.036, 0.032)], 0.02, 0.022), 16).save(
        "bird_head", along_x
    )
    loft([(0.0, 0.013, 0.012), (0.02, 0.010, 0.008, 0.002), (0.042, 0.001, 0.001, 0.007)], 10).save(
        "bird_beak", along_x
    )
    tail = [(-0.020, -0.01, -0.06, 0.01), (0.0, 0.0, -0.15, 0.012), (0.020, -0.01, -0.06, 0.01)]
    tail = [
        (-0.075, -0.105, -0.135, 0.004),
        (-0.045, -0.05, -0.155, 0.006),
        (0.0, 0.02, -0.16, 0.010),
        (0.045, -0.05, -0.155, 0.006),
        (0.075, -0.105, -0.135, 0.004),
    ]
    wing_panel(tail).save("bird_tail")
    inner = wing_panel(
        [
            (-0.015, 0.075, -0.10, 0.018),
            (0.06, 0.090, -0.105, 0.016),
            (0.125, 0.100, -0.095, 0.013),
            (0.165, 0.098, -0.088, 0.012),
        ]
    )
    outer = wing_panel(
        [
            (-0.016, 0.098, -0.088, 0.0105),
            (0.06, 0.082, -0.085, 0.010),
            (0.12, 0.045, -0.090, 0.008),
            (0.165, 0.000, -0.088, 0.006),
            (0.185, -0.045, -0.080, 0.004),
        ]
    )
    mirror = np.array([1.0, -1.0, 1.0])
    for name, mesh in (("inner", inner), ("outer", outer)):
        mesh.save(f"bird_wing_{name}_left")
        mesh.save(f"bird_wing_{name}_right", lambda points: points * mirror, flip=True)


def sphere(rings: int, sides: int) -> tuple[Array, Array, list[tuple[int, ...]]]:
    """A unit sphere's vertices, texture coordinates and faces."""
    lat = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    lon = np.linspace(-np.pi, np.pi, sides + 1)
    grid_lat, grid_lon = np.meshgrid(lat, lon, indexing="ij")
    points = np.stack(
        [np.cos(grid_lat) * np.cos(grid_lon), np.cos(grid_lat) * np.sin(grid_lon), np.sin(grid_lat)], axis=-1
    )
    uv = np.stack([(grid_lon / np.pi + 1) / 2, (grid_lat / np.pi) + 0.5], axis=-1)
    n = sides + 1
    faces = [
        (i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j) for i in range(rings) for j in range(sides)
    ]
    return points.reshape(-1, 3), uv.reshape(-1, 2), faces


def make_trees() -> None:
    """Crowns 1 m across and 1 m high above the origin: three of clumped leaves, one conifer."""
    rng = np.random.default_rng(7)
    ball, uv, faces = sphere(6, 9)
    seam = np.unique(np.round(ball, 6), axis=0, return_inverse=True)[1].ravel()  # so that jitter leaves no gap
    for name in "abc":
        mesh = Mesh()
        for i in range(13):
            lift = (i + rng.uniform(0, 0.7)) / 13
            spread = 0.34 * np.sin(np.pi * (0.22 + 0.68 * lift)) * rng.uniform(0.75, 1.05)
            turn = i * 2.4 + rng.uniform(-0.5, 0.5)
            center = np.array([spread * np.cos(turn), spread * np.sin(turn), 0.16 + 0.70 * lift])
            radius = rng.uniform(0.15, 0.22) * (1.15 - 0.45 * lift)
            ragged = rng.uniform(0.72, 1.22, seam.max() + 1)[seam]
            shape = ball * ragged[:, None] * radius * np.array([1.0, 1.0, 0.85])
            mesh.add(center + shape, uv * np.array([2.2, 1.2]) + rng.uniform(0, 1, 2), faces)
        core = np.array([0.0, 0.0, 0.5]) + ball * np.array([0.30, 0.30, 0.36])
        mesh.add(core, 2 * uv, faces)
        mesh.save(f"tree_crown_{name}")
    mesh = Mesh()
    sides = 14
    for i in range(7):
        low, high, radius = 0.02 + 0.13 * i, 0.02 + 0.13 * i + 0.24, 0.46 * (1 - i / 7.6)
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ragged = radius * (1 + 0.16 * np.cos(angle * sides / 2 + i) + 0.06 * np.tile(rng.standard_normal(1), sides + 1))
        rim = np.stack([ragged * np.cos(angle), ragged * np.sin(angle), np.full(sides + 1, low)], axis=1)
        tip = np.tile([0.0, 0.0, min(high, 1.0)], (sides + 1, 1))
        under = np.tile([0.0, 0.0, low + 0.04], (sides + 1, 1))
        u = np.linspace(0, 2, sides + 1)
        mesh.add(
            np.concatenate([rim, tip]),
            np.concatenate([np.stack([u, u * 0], 1), np.stack([u, u * 0 + 0.6], 1)]),
            [(j, j + 1, sides + 2 + j, sides + 1 + j) for j in range(sides)],
        )
        mesh.add(
            np.concatenate([rim, under]),
            np.concatenate([np.stack([u, u * 0], 1), np.stack([u, u * 0 + 0.2], 1)]),
            [(j + 1, j, sides + 1 + j, sides + 2 + j) for j in range(sides)],
        )
    mesh.save("tree_conifer")


def make_backdrops() -> None:
    """Hills and a far line of woods, as strips along x that face -y, 1 m being 1 m."""
    rng = np.random.default_rng(8)
    for name, half, height, count, rough, tile in (
        ("hills", 150.0, 17.0, 60, 0.5, 30.0),
        ("woods", 90.0, 6.5, 240, 0.12, 6.0),
    ):
        x = np.linspace(-half, half, count + 1)
        waves = sum(np.sin(x / half * k * 3.1 + rng.uniform(0, 6.3)) / k for k in (1, 2, 3.3, 5.1))
        top = height * (0.78 + 0.16 * waves) + (
            height * rough * 0.3 if name == "hills" else height * rough
        ) * np.convolve(rng.standard_normal(count + 1), np.ones(3) / 3, "same")
        rows = [
            np.stack([x, np.zeros_like(x), np.full_like(x, -2.0)], 1),
            np.stack([x, np.full_like(x, 0.35 * height), top], 1),
            np.stack([x, np.full_like(x, 0.9 * height), top * 0.1], 1),
        ]
        points = np.concatenate(rows)
        uv = np.stack([points[:, 0] / tile, (points[:, 2] + points[:, 1]) / tile], axis=1)
        n = count + 1
        mesh = Mesh()
        mesh.add(
            points,
            uv,
            [(i * n + j, i * n + j + 1, (i + 1) * n + j + 1, (i + 1) * n + j) for i in range(2) for j in range(count)],
        )
        mesh.save(f"outdoor_{name}")


def make_house() -> None:
    """A house 1 x 1 m in plan with walls 1 m high (front along x, facing -y) and a roof of its own, ridge along x."""
    walls = Mesh()
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    for i in range(4):
        a, b = corner[i], corner[(i + 1) % 4]
        points = np.array([[*a, 0], [*b, 0], [*b, 1], [*a, 1]], dtype=float)
        walls.add(points, np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), [(0, 1, 2, 3)])
    for x, order in ((-0.5, (0, 2, 1)), (0.5, (0, 1, 2))):
        gable = np.array([[x, -0.5, 1.0], [x, 0.5, 1.0], [x, 0.0, 1.62]])
        walls.add(gable, np.full((3, 2), 0.02) + np.array([[0, 0], [0.01, 0], [0, 0.01]]), [order])
    walls.save("outdoor_house")
    roof = Mesh()
    for sign in (-1.0, 1.0):
        low, high = sign * 0.58, 0.0
        for lift, flip in ((0.0, sign > 0), (-0.04, sign < 0)):
            points = np.array(
                [
                    [-0.54, low, 0.92 + lift],
                    [0.54, low, 0.92 + lift],
                    [0.54, high, 1.65 + lift],
                    [-0.54, high, 1.65 + lift],
                ]
            )
            order = (3, 2, 1, 0) if flip else (0, 1, 2, 3)
            roof.add(points, np.array([[0, 0], [2.0, 0], [2.0, 1.2], [0, 1.2]]), [order])
    roof.save("outdoor_roof")


def main() -> None:
    """Write everything."""
    TEXTURES.mkdir(exist_ok=True)
    MESHES.mkdir(exist_ok=True)
    for draw in (draw_markers, draw_book, draw_person, draw_bird, draw_indoor, draw_outdoor, draw_sky):
        draw()
    for make in (make_plate, make_person, make_bird, make_trees, make_backdrops, make_house):
        make()


if __name__ == "__main__":
    main()

"""Random CTs around bone shapes, made in a fraction of a second, with the label of every voxel.

Domain randomisation: what a scanner, a patient and an implant may change is drawn widely, so that real CTs may lie
within. The grey values are invented: soft tissue by smooth noise, bone as cortex and marrow by the distance to its
surface.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from training.segmentation.shapes import STEP_MM, UNIT_MM, BoneShape

_FEMORA = tuple(HIP.bone_names.index(f"femur_{side}") for side in ("left", "right"))
_HIPS = tuple(HIP.bone_names.index(f"hip_{side}") for side in ("left", "right"))
_SACRUM, _VERTEBRAE = HIP.bone_names.index("sacrum"), HIP.bone_names.index("vertebrae")
_AIR_HU, _FAT_HU = -1000.0, -100.0
_EDGE_MM = 3.0  # over which a bone's edge goes from nothing to all: a voxel


@dataclass(frozen=True)
class ScanSettings:
    """How random CTs are drawn. Ranges are of uniform distributions."""

    voxel_mm: float = 3.0
    sizes: tuple[tuple[int, int], ...] = ((3, 6), (4, 7), (4, 7))  # of the crop along z, y, x, in `multiple` voxels
    multiple: int = 16
    flexed_share: float = 0.35  # of patients whose femora are bent forwards by up to `flexion_deg`
    flexion_deg: float = 80.0
    metal_share: float = 0.3
    noise_hu: tuple[float, float] = (3.0, 70.0)
    field_of_view_share: float = 0.25  # of scans whose circle of reconstruction cuts the body


@dataclass(frozen=True, eq=False)
class Scan:
    """A random CT and its truth."""

    hu: Tensor  # (Z, Y, X) float32
    labels: Tensor  # (Z, Y, X) uint8, 0 or 1 + the number of the bone in the anatomy


class _Draw:
    """Random numbers from one seed, for NumPy and torch alike."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.torch = torch.Generator().manual_seed(int(self.rng.integers(2**62)))

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def happens(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def smooth(self, shape: tuple[int, ...], nodes_apart: float) -> Tensor:
        """Smooth noise (Z, Y, X) of about unit deviation; `nodes_apart` voxels."""
        coarse = [max(2, math.ceil(n / nodes_apart) + 1) for n in shape]
        noise = torch.randn((1, 1, *coarse), generator=self.torch)
        return 1.5 * F.interpolate(noise, shape, mode="trilinear", align_corners=True)[0, 0]


def random_scan(shape: BoneShape, seed: int, settings: ScanSettings) -> Scan:
    """A crop of a random CT around a shape: bent, scaled, mirrored, moved femora, everything else drawn anew."""
    draw = _Draw(seed)
    size = tuple(settings.multiple * int(draw.rng.integers(a, b + 1)) for a, b in settings.sizes)
    posed = _posed(shape, draw, size, settings)
    mirrored = draw.happens(0.5)
    distance = posed.distance[[HIP.bone_names.index(bone.mirror) for bone in HIP.bones]] if mirrored else posed.distance
    distance = distance.flip(3) if mirrored else distance
    points = posed.points.flip(2) * torch.tensor([-1.0, 1, 1]) if mirrored else posed.points
    flip = np.array([-1.0, 1, 1]) if mirrored else np.ones(3)
    heads = posed.heads[::-1] * flip if mirrored else posed.heads
    shafts = posed.shafts[::-1] * flip if mirrored else posed.shafts
    labels = _labels(distance)
    scene = _Scene(distance, points, heads, shafts, settings.voxel_mm)
    hu = _tissue(scene, draw)
    hu = _bones(hu, scene, draw)
    hu = _calcium(hu, scene, draw)
    if draw.happens(settings.metal_share):
        hu = _metal(hu, scene, draw)
    hu = _scanned(hu, scene, draw, settings)
    return Scan(hu, labels)


@dataclass(frozen=True, eq=False)
class _Posed:
    distance: Tensor  # (6, Z, Y, X) mm, float32
    points: Tensor  # (Z, Y, X, 3) mm in the patient, middle of the heads at the origin
    heads: np.ndarray  # (2, 3) left, right
    shafts: np.ndarray  # (2, 3) unit vectors down the shafts


@dataclass(frozen=True, eq=False)
class _Scene(_Posed):
    voxel_mm: float

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.points.shape[:3])


def _rotation(x_deg: float, y_deg: float, z_deg: float) -> np.ndarray:
    a, b, c = np.radians([x_deg, y_deg, z_deg])
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _posed(shape: BoneShape, draw: _Draw, size: tuple[int, ...], settings: ScanSettings) -> _Posed:
    voxel = settings.voxel_mm
    middle = shape.heads.mean(0)
    heads = shape.heads - middle
    # where the crop lies: its middle is near a point between mid femur and lumbar spine
    centre = np.array([draw.between(-90, 90), draw.between(-40, 60), draw.between(-110, 150)])
    turn = _rotation(*draw.rng.normal(0, (9, 5, 5)))
    scale = draw.between(0.87, 1.15) * draw.rng.normal(1, 0.04, 3)
    axes = [voxel * (torch.arange(n) - (n - 1) / 2) + c for n, c in zip(size, centre[::-1], strict=True)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    points = torch.stack([x, y, z], -1).float()
    to_shape = np.diag(1 / scale) @ turn.T  # from the posed patient to the shape, both about the heads' middle
    local = points @ torch.tensor(to_shape.T, dtype=torch.float32)
    bend = torch.stack([draw.smooth(size, 70 / voxel) for _ in range(3)], -1) * draw.between(0, 4)
    local = local + bend
    from_shape = turn @ np.diag(scale)
    bones = [k for k in range(len(HIP.bones)) if k not in _FEMORA]
    distance = torch.empty((len(HIP.bones), *size))
    distance[bones] = _sampled(shape, bones, local, middle)
    shafts = []
    flexion = draw.between(0, settings.flexion_deg) if draw.happens(settings.flexed_share) else draw.between(-12, 12)
    for n, k in enumerate(_FEMORA):
        sign = 1 if n == 0 else -1
        own = flexion + draw.between(-8, 8) if draw.happens(0.8) else draw.between(-12, settings.flexion_deg)
        move = _rotation(-own, -sign * draw.between(-12, 25), sign * draw.between(-35, 35))
        head = torch.tensor(heads[n], dtype=torch.float32)
        turned = (local - head) @ torch.tensor(move, dtype=torch.float32) + head
        distance[k] = _sampled(shape, [k], turned, middle)[0]
        down = from_shape @ move @ np.array([0.0, 0, -1])
        shafts.append(down / np.linalg.norm(down))
    distance *= float(np.prod(scale) ** (1 / 3))
    gap = draw.between(0.3, 2.5)
    for hip, femur in zip(_HIPS, _FEMORA, strict=True):  # a femur that was turned does not enter the hip bone
        distance[femur] = torch.maximum(distance[femur], gap - distance[hip])
    return _Posed(distance, points, heads @ from_shape.T, np.array(shafts))


def _sampled(shape: BoneShape, bones: list[int], local: Tensor, middle: np.ndarray) -> Tensor:
    """Distances (len(bones), Z, Y, X) mm at points (Z, Y, X, 3) about `middle`; beyond the grid those of its rim.

    Below a cut the shaft goes on so.
    """
    counts = torch.tensor(shape.distance.shape[:0:-1], dtype=torch.float32)
    offset = torch.tensor(shape.first - middle, dtype=torch.float32)
    grid = 2 * (local - offset) / (STEP_MM * (counts - 1)) - 1
    values = F.grid_sample(shape.distance[bones][None].float(), grid[None], padding_mode="border", align_corners=True)
    return values[0] * UNIT_MM


def _labels(distance: Tensor) -> Tensor:
    nearest, bone = distance.min(0)
    return torch.where(nearest < 0, bone + 1, 0).to(torch.uint8)


def _share(distance: Tensor, edge_mm: float = _EDGE_MM) -> Tensor:
    """Of a voxel that lies within, by the distance of its middle."""
    return (0.5 - distance / edge_mm).clamp(0, 1)


def _capsule(points: Tensor, a: np.ndarray, b: np.ndarray) -> Tensor:
    """Distance to the line from a to b, mm."""
    start, along = (torch.tensor(v, dtype=torch.float32) for v in (a, b - a))
    offset = points - start
    t = (offset @ along / (along @ along)).clamp(0, 1)
    return (offset - t[..., None] * along).norm(dim=-1)


def _tissue(scene: _Scene, draw: _Draw) -> Tensor:
    """Air, fat, muscle, bowel, vessels and table: (Z, Y, X) HU without bones."""
    points, shape, voxel = scene.points, scene.shape, scene.voxel_mm
    x, y, z = points.unbind(-1)
    half = float(np.abs(scene.heads[:, 0]).max()) + draw.between(50, 130)
    depth = draw.between(85, 190)
    back = draw.between(20, 50)
    wobble = draw.smooth(shape, 60 / voxel) * 6
    crotch = draw.between(-90, -40)
    trunk = ((x / half) ** 2 + ((y - back) / depth) ** 2).clamp(min=1e-6).sqrt()
    body = (trunk - 1) * min(half, depth) + wobble
    body = torch.maximum(body, crotch - z)
    thick = draw.between(55, 115)
    for n in range(2):
        knee = scene.heads[n] + 500 * scene.shafts[n]
        body = torch.minimum(body, _capsule(points, scene.heads[n], knee) - thick + wobble)
    layer = draw.between(3, 45)
    muscle = draw.between(20, 75)
    fat = draw.between(-125, -70)
    streaky = draw.smooth(shape, draw.between(5, 15) / voxel) + 0.5 * draw.smooth(shape, 40 / voxel)
    near = scene.distance.min(0).values
    lean = _share(-(streaky + draw.between(0.2, 1.6)) * 4 + 0.03 * near)
    hu = fat + lean * (muscle - fat)
    hollow = ((x / draw.between(55, 90)) ** 2 + ((y + 15) / 70) ** 2 < 1) | (z > 60)
    bowel = draw.smooth(shape, 25 / voxel)
    soft = draw.between(0, 60) + 20 * bowel
    inside = hollow & (body < -25)
    hu = torch.where(inside & (bowel > 0), soft, hu)
    if draw.happens(0.5):
        hu = torch.where(inside & (bowel > draw.between(1.1, 2.0)), torch.tensor(draw.between(-950, -300)), hu)
    if draw.happens(0.3):  # contrast medium in bowel or bladder
        hu = torch.where(inside & (bowel < draw.between(-2.5, -1.2)), torch.tensor(draw.between(120, 700)), hu)
    if draw.happens(0.4):  # and in vessels
        bright = draw.between(100, 420)
        for n in range(2):
            groin = scene.heads[n] + draw.rng.normal(0, 8, 3) + [0, -draw.between(28, 45), 0]
            for b in ([0, groin[1] + 15, 150], groin + 400 * scene.shafts[n]):
                tube = _capsule(points, groin, np.array(b, float)) - draw.between(3, 7)
                hu += _share(tube) * (bright - hu) * (near > 0)
    hu = torch.where(body > -layer, fat + 0.1 * (hu - fat), hu)
    hu = _AIR_HU + _share(body, 4.0) * (hu - _AIR_HU)
    if draw.happens(0.3):  # hands and forearms beside the body
        for sign in (1, -1):
            a = np.array([sign * (half + draw.between(5, 50)), draw.between(-60, 60), draw.between(-80, 60)])
            b = a + np.array([sign * draw.between(-10, 60), draw.between(-60, 60), 260])
            flesh = _capsule(points, a, b) - draw.between(25, 45)
            hu = torch.where(flesh < 0, torch.tensor(muscle), hu)
            for _ in range(2):
                shift = draw.rng.normal(0, 10, 3)
                bone = _capsule(points, a + shift, b + shift) - draw.between(4, 10)
                hu += _share(bone) * (draw.between(300, 1200) - hu)
    if draw.happens(0.7):  # a table: a shell around foam
        top = float(back + depth + draw.between(0, 30)) if draw.happens(0.8) else draw.between(100, 160)
        surface = y - top + (x / draw.between(250, 900)) ** 2 * -draw.between(0, 60)
        foam, shell = draw.between(-1000, -700), draw.between(-500, 400)
        hu = torch.where((surface > 0) & (body > 0), torch.tensor(foam), hu)
        for at in (0.0, draw.between(15, 50)):
            hu = torch.where(((surface - at).abs() < draw.between(1, 3)) & (body > 0), torch.tensor(shell), hu)
    return hu


def _bones(hu: Tensor, scene: _Scene, draw: _Draw) -> Tensor:
    """Cortex of varying thickness around marrow, in all bones; cartilage and hard bone where two meet."""
    shape, voxel = scene.shape, scene.voxel_mm
    density = draw.between(0.4, 1.5)
    marrow_base = draw.between(-60, 320) * density
    hips, femora = scene.distance[list(_HIPS)].min(0).values, scene.distance[list(_FEMORA)].min(0).values
    if draw.happens(0.7):  # cartilage and capsule
        joint = _share(torch.maximum(hips - 4, femora - 4))
        hu = hu + joint * (draw.between(30, 140) - hu) * (hu > -300)
    patches = draw.smooth(shape, draw.between(8, 30) / voxel)
    thinning = (0.35 * draw.smooth(shape, 25 / voxel)).exp().clamp(0.3, 2.5)
    grain = draw.smooth(shape, 2.0) * draw.between(0, 90)
    sclerosis = draw.between(0, 500) if draw.happens(0.4) else 0.0
    swollen = draw.between(-0.6, 0.6)
    for k in range(len(HIP.bones)):
        d = scene.distance[k] + swollen
        within = _share(d)
        if not bool((within > 0).any()):
            continue
        thickness = draw.between(0.5, 2.2) * thinning
        if k in _FEMORA:
            n = _FEMORA.index(k)
            head, down = (torch.tensor(v, dtype=torch.float32) for v in (scene.heads[n], scene.shafts[n]))
            along = (scene.points - head) @ down
            shaft = ((along - 40) / 60).clamp(0, 1)
            thickness = thickness + shaft * draw.between(1.5, 6)
        else:
            shaft = torch.zeros(())
        cortex = draw.between(450, 1500) * (0.6 + 0.4 * density)
        marrow = marrow_base + draw.between(-60, 60) + draw.between(10, 110) * patches + grain
        marrow = marrow - (draw.between(0, 12) * (-d - 6).clamp(0, 15)) - shaft * draw.between(0, 250)
        if k in _FEMORA and draw.happens(0.6):  # the trabeculae that carry the load meet in the middle of the head
            middle = (scene.points - head).norm(dim=-1) / draw.between(8, 18)
            marrow = marrow + draw.between(50, 400) * (-middle.square()).exp()
        if k in (*_HIPS, *_FEMORA):
            other = femora if k in _HIPS else hips
            marrow = marrow + sclerosis * (-(other - 2).clamp(min=0) / 6).exp()
        inner = _share(d + thickness)
        hu = hu * (1 - within) + within * cortex + inner * (marrow.clamp(min=-130) - cortex)
    return hu


def _calcium(hu: Tensor, scene: _Scene, draw: _Draw) -> Tensor:
    """Calcified vessels, phleboliths, stones and small bones that have no name here."""
    low, high = scene.points.reshape(-1, 3).min(0).values.numpy(), scene.points.reshape(-1, 3).max(0).values.numpy()
    outside = scene.distance.min(0).values > 1
    for _ in range(int(draw.rng.integers(0, 8))):
        a = draw.rng.uniform(low, high)
        b = a + draw.rng.normal(0, 1, 3) * (draw.between(0, 60) if draw.happens(0.4) else 1)
        tube = _capsule(scene.points, a, b) - draw.between(1, 7)
        hu = hu + _share(tube) * outside * (hu > -300) * (draw.between(150, 1100) - hu)
    return hu


def _metal(hu: Tensor, scene: _Scene, draw: _Draw) -> Tensor:
    """A nail with neck screw, a hip prosthesis, screws or a plate; and the streaks from it. Bone stays bone."""
    points = scene.points
    n = int(draw.rng.integers(2))
    head, down = scene.heads[n], scene.shafts[n]
    side = np.array([1.0 if n == 0 else -1.0, 0, 0])
    neck = side * 0.75 + down * 0.65
    neck /= np.linalg.norm(neck)
    shaft = head + 48 * side + 45 * down
    kind = draw.rng.choice(["nail", "prosthesis", "screws", "plate", "spine"])
    parts: list[Tensor] = []
    if kind == "nail":
        parts.append(_capsule(points, shaft - 40 * down, shaft + draw.between(100, 350) * down) - draw.between(4, 7))
        parts.append(_capsule(points, head, head + 85 * neck) - draw.between(3, 6))
    elif kind == "prosthesis":
        parts.append((points - torch.tensor(head, dtype=torch.float32)).norm(dim=-1) - draw.between(13, 19))
        parts.append(_capsule(points, head, head + 45 * neck) - draw.between(5, 8))
        parts.append(_capsule(points, head + 45 * neck, shaft + draw.between(60, 140) * down) - draw.between(5, 8))
        if draw.happens(0.7):
            shell = (points - torch.tensor(head, dtype=torch.float32)).norm(dim=-1)
            cup = torch.maximum(
                (shell - draw.between(25, 28)).abs() - 2.5, (points @ torch.tensor(neck).float()) - head @ neck
            )
            parts.append(cup)
    elif kind == "screws":
        for _ in range(int(draw.rng.integers(1, 4))):
            a = head + draw.rng.normal(0, 12, 3)
            parts.append(_capsule(points, a, a + 80 * neck) - draw.between(2, 4))
    elif kind == "plate":
        a = shaft + 18 * side
        parts.append(_capsule(points, a, a + draw.between(60, 250) * down) - draw.between(4, 8))
        parts.append(_capsule(points, head, a) - draw.between(3, 6))
    else:
        for sign in (1, -1):
            a = np.array([sign * draw.between(15, 35), draw.between(20, 60), draw.between(60, 120)])
            parts.append(_capsule(points, a, a + draw.rng.normal(0, 20, 3) + [0, -30, 0]) - draw.between(2, 4))
            parts.append(_capsule(points, a, a + np.array([0, 10, 120])) - draw.between(2, 4))
    metal = torch.stack(parts).min(0).values
    share = _share(metal)
    hu = hu + share * (draw.between(2000, 6000) - hu)
    if draw.happens(0.8):
        hu = hu + _streaks(points, metal, draw)
    return hu


def _streaks(points: Tensor, metal: Tensor, draw: _Draw) -> Tensor:
    """Bright and dark rays in the slices with metal, weaker with distance."""
    x, y, _ = points.unbind(-1)
    strength = draw.between(30, 450)
    slices = metal.flatten(1).min(1).values < 3
    result = torch.zeros_like(metal)
    for k in torch.nonzero(slices).flatten().tolist():
        row = metal[k]
        at = int(row.argmin())
        dx, dy = x[k] - x[k].flatten()[at], y[k] - y[k].flatten()[at]
        angle, radius = torch.atan2(dy, dx), (dx**2 + dy**2).sqrt()
        rays = torch.randn(48, generator=draw.torch)
        place = (angle / (2 * math.pi) + 0.5) * 48
        low = place.long() % 48
        part = place - place.floor()
        ray = rays[low] * (1 - part) + rays[(low + 1) % 48] * part
        result[k] = strength * ray * (-radius / draw.between(40, 120)).exp() * (row > 0)
    return result


def _scanned(hu: Tensor, scene: _Scene, draw: _Draw, settings: ScanSettings) -> Tensor:
    """Blur of kernel and slices, cupping, noise, field of view, and what scanners store."""
    shape, voxel = scene.shape, scene.voxel_mm
    if draw.happens(0.35):  # slices thicker than the voxels
        weight = draw.between(0.1, 0.33)
        kernel = torch.tensor([weight, 1 - 2 * weight, weight]).reshape(1, 1, 3, 1, 1)
        hu = F.conv3d(F.pad(hu[None, None], (0, 0, 0, 0, 1, 1), mode="replicate"), kernel)[0, 0]
    if draw.happens(0.4):  # a soft kernel, or one that overshoots
        blurred = F.avg_pool3d(F.pad(hu[None, None], (1,) * 6, mode="replicate"), 3, 1)[0, 0]
        hu = hu + draw.between(-0.4, 0.4) * (blurred - hu)
    body = (hu > -500).float()
    hu = hu + body * draw.smooth(shape, 60 / voxel) * draw.between(0, 25)
    noise = torch.randn(shape, generator=draw.torch)
    if draw.happens(0.5):
        noise = 1.5 * F.avg_pool3d(F.pad(noise[None, None], (1,) * 6, mode="replicate"), (1, 3, 3), 1)[0, 0][1:-1]
    hu = hu + noise * math.exp(draw.between(*np.log(settings.noise_hu))) * draw.between(0.3, 1)
    hu = hu * draw.between(0.92, 1.08) + draw.between(-20, 20)
    hu = hu.clamp(-1024, 3071)
    if draw.happens(settings.field_of_view_share):
        x, y, _ = scene.points.unbind(-1)
        cx, cy, radius = draw.between(-110, 110), draw.between(-40, 60), draw.between(90, 230)
        hu = torch.where((x - cx) ** 2 + (y - cy) ** 2 > radius**2, torch.tensor(-1024.0), hu)
    if draw.happens(0.3):  # where the CT ends, a network's input is filled with air
        axis = int(draw.rng.integers(3))
        cut = int(draw.rng.integers(1, max(2, shape[axis] // 5)))
        ends = slice(0, cut) if draw.happens(0.5) else slice(shape[axis] - cut, None)
        index: list[slice] = [slice(None)] * 3
        index[axis] = ends
        hu[tuple(index)] = -1024.0
    return hu

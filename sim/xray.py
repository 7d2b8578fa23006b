"""Simulated fluoroscopy: from areal densities of soft tissue, bone and metal to raw 16-bit images.

The chain of one image: polychromatic Beer–Lambert, scatter, quantum noise, blur of the scintillator, electronic noise,
digitisation. Every strength is a field of `XrayModel`; the values of the paper's preset stand in `configs/simulation/`.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera
from femoreg_torch.volume import Volume
from sim.materials import mass_attenuation, tissue_densities, tungsten_spectrum

_FULL_SCALE = 65535


@dataclass(frozen=True)
class XrayModel:
    """Tube and detector of the simulated C-arm."""

    kvp: float  # tube voltage
    aluminium_mm: float  # total filtration
    energy_bins: int
    photons: float  # detected per pixel in the open beam
    scatter: float  # scattered to primary energy, per attenuation length of the object behind the pixel
    scatter_sigma_mm: float  # on the detector
    blur_sigma_px: float  # scintillator
    electronic_noise: float  # standard deviation, in photons
    open_beam_counts: float  # digital value of the open beam


def tissue_volumes(ct: Volume) -> tuple[Volume, Volume]:
    """Mass densities (soft tissue, bone) in g/cm³ on the grid of a CT in HU."""
    soft, bone = tissue_densities(ct.data)
    return ct.with_data(soft), ct.with_data(bone)


def areal_densities(
    densities: Mapping[str, Volume], camera_from_lps: Tensor, camera: Camera, step_mm: float
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² along every ray, for each material.

    `densities` are in g/cm³; `camera_from_lps` (4, 4) maps their common mm space into the camera frame.
    """
    poses = camera_from_lps.expand(1, len(densities), 4, 4)
    integrals = project(list(densities.values()), poses, camera, step_mm, separate=True)[0]
    return dict(zip(densities, integrals / 10, strict=True))  # mm · g/cm³ to g/cm²


def transmission(areal: Mapping[str, Tensor], model: XrayModel) -> Tensor:
    """Share (H, W) of the open beam's energy that reaches each pixel: Beer–Lambert per energy, weighted by the energy.

    `areal` maps material names (`sim.materials`) to mass per area (H, W) in g/cm².
    """
    energies, photons = tungsten_spectrum(model.kvp, model.aluminium_mm, model.energy_bins)
    weights = photons * energies / (photons * energies).sum()
    coefficients = {name: mass_attenuation(name, energies).tolist() for name in areal}
    image = torch.zeros_like(next(iter(areal.values())))
    for i, weight in enumerate(weights.tolist()):
        exponent = torch.zeros_like(image)
        for name, mass in areal.items():
            exponent.sub_(mass, alpha=coefficients[name][i])
        image.add_(exponent.exp_(), alpha=weight)
    return image


def scattered(primary: Tensor, model: XrayModel, camera: Camera) -> Tensor:
    """Scatter (H, W) in units of the open beam: a wide blur of −P ln P, the forward-scatter model.

    Ohnesorge, Flohr, Klingenbeck-Regn, Efficient object scatter correction algorithm for third and fourth generation CT
    scanners, Eur Radiol 9 (1999) 563.
    """
    source = -primary * primary.clamp_min(1e-8).log()
    coarse = max(1, round(model.scatter_sigma_mm / camera.pixel_mm[0] / 8))  # the field is smooth: 8 samples per sigma
    small = torch.nn.functional.avg_pool2d(source[None, None], coarse, ceil_mode=True)[0, 0].numpy()
    sigma = [model.scatter_sigma_mm / (spacing * coarse) for spacing in camera.pixel_mm]
    field = torch.from_numpy(ndimage.gaussian_filter(small, sigma, mode="nearest"))
    size = list(primary.shape)
    wide = torch.nn.functional.interpolate(field[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
    return model.scatter * wide


def detect(energy: Tensor, model: XrayModel, generator: torch.Generator) -> Tensor:
    """Raw image (H, W) uint16 of the energy (H, W) that falls on the detector, in units of the open beam; bone is dark.

    Quanta are Poisson, are spread by the scintillator (so their noise is correlated), then electronic noise is added.
    """
    quanta = torch.poisson((energy * model.photons).to(torch.float32), generator=generator)
    signal = blur(quanta, model.blur_sigma_px)
    signal += model.electronic_noise * torch.randn(signal.shape, generator=generator)
    counts = signal * (model.open_beam_counts / model.photons)
    return counts.round_().clamp_(0, _FULL_SCALE).to(torch.uint16)


def blur(image: Tensor, sigma_px: float) -> Tensor:
    """Gaussian blur (H, W) that keeps the mean of the image (mirrored border)."""
    if sigma_px == 0:
        return image.clone()
    return torch.from_numpy(ndimage.gaussian_filter(image.numpy(), sigma_px, mode="reflect"))


def fluoroscopy(areal: Mapping[str, Tensor], camera: Camera, model: XrayModel, generator: torch.Generator) -> Tensor:
    """Raw fluoroscopic image (H, W) uint16 behind the given mass per area (H, W) in g/cm² of each material."""
    primary = transmission(areal, model)
    return detect(primary + scattered(primary, model, camera), model, generator)

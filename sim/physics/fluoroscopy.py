"""Simulated fluoroscopy: from areal densities of soft tissue, bone and metal to raw 16-bit images.

The chain of one image: polychromatic Beer–Lambert, fall-off of the beam, scatter, motion, quantum noise, blur of the
scintillator, glare and vignetting of an image intensifier, electronic noise, gain, digitisation. Every strength is a
field of `XrayModel`; the values of the paper's preset stand in `configs/simulation/`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.geometry import Camera
from femoreg_torch.settings import check_within
from femoreg_torch.volume.materials import mass_attenuation
from sim.physics.beam import open_beam, shutter
from sim.physics.detector import digitise, gain_pattern, motion_blur, record_quanta, veiling_glare, vignetting
from sim.physics.spectrum import fluence, tungsten_spectrum

_ROWS = 32  # of an image at a time, which stay in the processor's cache for all energies


XRAY_RANGES: dict[str, tuple[float, float]] = {  # of what a C-arm can do, and more
    "kvp": (20, 100),  # the tables of attenuation end there
    "aluminium_mm": (0, 100),
    "energy_bins": (1, 200),
    "k_lines": (0, 10),
    "dose_ugy": (1e-3, 1e6),
    "quantum_efficiency": (0.01, 1),
    "heel": (-1, 1),
    "collimator_mm": (0, 2000),
    "scatter": (0, 10),
    "scatter_sigma_mm": (0, 500),
    "motion_mm": (0, 50),
    "blur_sigma_mm": (0, 20),
    "electronic_noise": (0, 1e6),
    "gain_spread": (0, 1),
    "open_beam_counts": (10, 1e12),
}


@dataclass(frozen=True)
class XrayModel:
    """Tube and detector of the simulated C-arm. What is 0 (or false) is switched off."""

    kvp: float  # tube voltage
    aluminium_mm: float  # total filtration
    energy_bins: int
    k_lines: float  # photons in the K lines of tungsten, at twice its K edge, per other photon
    dose_ugy: float  # air kerma of one image on the detector, in the open beam
    quantum_efficiency: float  # of the detector
    inverse_square: bool  # fall-off of the beam from the central ray
    heel: float  # share of the beam lost across the detector, towards the anode
    collimator_mm: float  # radius of a round collimator, on the detector; 0 is open
    scatter: float  # scatter-to-primary ratio (of energies) per attenuation length in front of the pixel
    scatter_sigma_mm: float  # on the detector
    motion_mm: float  # longest path of the shadow on the detector during one image
    blur_sigma_mm: float  # scintillator
    electronic_noise: float  # standard deviation, in photons per mm of a pixel's width
    gain_spread: float  # standard deviation of the pixels' gain after flat-field correction
    open_beam_counts: float  # digital value of the open beam
    shutter_width_mm: float = 0.0  # of a rectangular opening, on the detector; 0 is open
    shutter_height_mm: float = 0.0
    shutter_deg: float = 0.0  # by which it is turned, from columns to rows
    glare: float = 0.0  # share of the light that is spread widely
    glare_mm: float = 0.0  # how wide, on the detector
    vignetting: float = 0.0  # share of the light lost at the middle of the detector's edges

    def __post_init__(self) -> None:
        check_within(
            self,
            **XRAY_RANGES,
            shutter_width_mm=(0, 2000),
            shutter_height_mm=(0, 2000),
            shutter_deg=(-360, 360),
            glare=(0, 1),
            glare_mm=(0, 500),
            vignetting=(0, 1),
        )


def transmission(areal: Mapping[str, Tensor], model: XrayModel) -> Tensor:
    """Share (H, W) of the open beam's energy that reaches each pixel: Beer–Lambert per energy, weighted by the energy.

    `areal` maps material names (`femoreg_torch.volume.materials`) to mass per area (H, W) in g/cm².
    """
    energies, photons = tungsten_spectrum(model.kvp, model.aluminium_mm, model.energy_bins, model.k_lines)
    weights = photons * energies / (photons * energies).sum()
    coefficients = {name: mass_attenuation(name, energies).tolist() for name in areal}
    image = torch.zeros_like(next(iter(areal.values())))
    for start in range(0, len(image), _ROWS):
        rows = slice(start, start + _ROWS)
        for i, weight in enumerate(weights.tolist()):
            exponent = torch.zeros_like(image[rows])
            for name, mass in areal.items():
                exponent.sub_(mass[rows], alpha=coefficients[name][i])
            image[rows].add_(exponent.exp_(), alpha=weight)
    return image


def photons_per_pixel(model: XrayModel, camera: Camera) -> float:
    """Photons that the detector records in one pixel of the open beam."""
    energies, photons = tungsten_spectrum(model.kvp, model.aluminium_mm, model.energy_bins, model.k_lines)
    area_cm2 = camera.pixel_mm[0] * camera.pixel_mm[1] / 100
    return model.quantum_efficiency * fluence(model.dose_ugy, energies, photons) * area_cm2


def scattered(primary: Tensor, model: XrayModel, camera: Camera, beam: Tensor) -> Tensor:
    """Scatter (H, W) in units of the open beam: a wide Gaussian blur of −P ln P, the forward-scatter model.

    `primary` (H, W) is the share P that is transmitted, `beam` (H, W) what falls on the object. A convolution of the
    weighted projection as in Ohnesorge, Flohr, Klingenbeck-Regn, Efficient object scatter correction algorithm for
    third and fourth generation CT scanners, Eur Radiol 9 (1999) 563; the weight and the Gaussian are chosen here.
    """
    source = -primary * primary.clamp_min(1e-8).log() * beam
    coarse = max(1, round(model.scatter_sigma_mm / camera.pixel_mm[0] / 8))  # the field is smooth: 8 samples per sigma
    small = torch.nn.functional.avg_pool2d(source[None, None], coarse, ceil_mode=True)[0, 0].cpu().numpy()
    sigma = [model.scatter_sigma_mm / (spacing * coarse) for spacing in camera.pixel_mm]
    field = torch.from_numpy(ndimage.gaussian_filter(small, sigma, mode="nearest")).to(primary.device)
    size = list(primary.shape)
    wide = torch.nn.functional.interpolate(field[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
    return model.scatter * wide


def detect(energy: Tensor, model: XrayModel, camera: Camera, generator: torch.Generator) -> Tensor:
    """Raw image (H, W) uint16 of the energy (H, W) that falls on the detector, in open beams; bone is dark."""
    if model.motion_mm:
        length, angle = torch.rand(2, generator=generator).tolist()
        energy = motion_blur(energy, length * model.motion_mm / camera.pixel_mm[1], math.pi * angle)
    photons = photons_per_pixel(model, camera)
    signal = record_quanta(energy, photons, model.blur_sigma_mm / camera.pixel_mm[1], generator)
    if model.glare:
        signal = veiling_glare(signal, camera, model.glare, model.glare_mm)
    if model.vignetting:
        signal *= vignetting(camera, model.vignetting)
    signal += model.electronic_noise * camera.pixel_mm[1] * torch.randn(signal.shape, generator=generator)
    if model.gain_spread:
        signal *= gain_pattern(camera.shape, model.gain_spread)
    return digitise(signal, model.open_beam_counts / photons)


def fluoroscopy(areal: Mapping[str, Tensor], camera: Camera, model: XrayModel, generator: torch.Generator) -> Tensor:
    """Raw fluoroscopic image (H, W) uint16 behind the given mass per area (H, W) in g/cm² of each material.

    The beam is attenuated where the masses lie, and detected on the CPU, where the image comes to.
    """
    primary = transmission(areal, model)
    beam = open_beam(camera, model.inverse_square, model.heel, model.collimator_mm)
    if model.shutter_width_mm and model.shutter_height_mm:
        beam = beam * shutter(camera, model.shutter_width_mm, model.shutter_height_mm, model.shutter_deg)
    beam = beam.to(primary.device)
    return detect((beam * primary + scattered(primary, model, camera, beam)).cpu(), model, camera, generator)

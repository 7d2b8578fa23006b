"""Bounds of a coarse simulated procedure: its photons are the simulator's, and so are their changes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from coarse import PROCEDURE, SIMULATION, stores_in
from femoreg_torch.configs import laid_over, load_preset

from femoreg_torch.case.femoroplasty import DEVICE
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import about_point, exp_se3
from femoreg_torch.registration import load_plan
from femoreg_torch.statistics.limit_tables import ALL_IMAGES, BOUND, INFORMATION, NOISE, USUAL
from femoreg_torch.statistics.quantities import QUANTITIES
from femoreg_torch.volume import read_mesh
from sim.physics.fluoroscopy import photons_per_pixel
from sim.study.conditions import Body, image_views
from sim.study.exposures import Drawn, simulated_images
from sim.study.limits import Imagined, bound_rows, imagine, limits
from sim.study.protocol import Variation
from sim.study.responses import centres_in
from sim.study.work import Setting
from sim.theatre.preoperative_case import read_preoperative
from sim.theatre.procedure import draw_procedure
from sim.theatre.settings import load_simulation

PIXEL_MM = 3.1
TOTALS = [quantity.column for quantity in QUANTITIES]


def setting_of(root: Path, **xray: Any) -> Setting:
    change = {"acquisition": {"device_materials": "mixed"}, "xray": {"gain_spread": 0} | xray}
    content = laid_over(load_preset("simulation", root / SIMULATION), change, "test")
    return Setting(Variation("plain"), load_plan("fast"), content, None, None)


@pytest.fixture(scope="module")
def body(coarse_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Body:
    return Body(PROCEDURE, stores_in(coarse_root), tmp_path_factory.mktemp("body"))


@pytest.fixture(scope="module")
def imagined(coarse_root: Path, body: Body, tmp_path_factory: pytest.TempPathFactory) -> Imagined:
    return imagine(setting_of(coarse_root), PROCEDURE, body, tmp_path_factory.mktemp("imagined"), PIXEL_MM)


@pytest.fixture(scope="module")
def drawn(imagined: Imagined) -> dict[tuple[str, int], Drawn]:
    return {(image.kind, image.view): image for image in simulated_images(imagined.theatre)}


def test_photons_and_their_noise_are_those_of_the_simulator(
    coarse_root: Path, body: Body, imagined: Imagined, drawn: dict[tuple[str, int], Drawn], tmp_path: Path
) -> None:
    """Raw images, as numbers of photons, differ from what is expected by as much as is expected."""
    settings = load_simulation(coarse_root / SIMULATION)
    settings = replace(
        settings,
        acquisition=replace(settings.acquisition, device_materials="mixed"),
        xray=replace(settings.xray, gain_spread=0, blur_sigma_mm=0),
    )
    known = read_preoperative(body.patient(), PROCEDURE.hip, body.device_seed, settings, tmp_path / "device.stl")
    generator = torch.Generator().manual_seed(PROCEDURE.seed)
    procedure = draw_procedure(known, read_mesh(known.device.model.path), settings.acquisition, generator)
    torch.testing.assert_close(procedure.truth.camera_from(DEVICE), imagined.theatre.poses.camera_from(DEVICE))
    images = image_views(body, known, procedure, settings, generator)
    per_count = photons_per_pixel(settings.xray, known.case.carm.camera) / settings.xray.open_beam_counts
    for (kind, view), image in drawn.items():
        raw = getattr(images[view], kind).float()
        seen = raw < 65535
        off = (raw * per_count - image.expected)[seen] / image.variance.sqrt()[seen]
        assert seen.float().mean() > 0.5
        assert off.median().abs() < 0.15
        assert off.abs().median() / 0.6745 == pytest.approx(1, abs=0.1)  # that of a Gaussian


def test_changes_by_the_device_are_those_of_photons_expected_anew(
    imagined: Imagined, drawn: dict[tuple[str, int], Drawn]
) -> None:
    theatre = imagined.theatre
    centre = centres_in(theatre.poses, theatre.points, 0)[DEVICE]

    def photons(twist: torch.Tensor) -> torch.Tensor:
        moved = about_point(exp_se3(twist), centre) @ theatre.poses.camera1_from[DEVICE]
        poses = theatre.poses.with_object(DEVICE, moved)
        # scattered light changes too, and is not taken to inform: it is left out here
        there = replace(theatre, poses=poses, model=replace(theatre.model, scatter=0))
        return next(i.expected for i in simulated_images(there) if (i.kind, i.view) == ("device", 0))

    for place, size in ((1, 0.0005), (3, 0.02), (5, 0.1)):
        step = torch.zeros(6, dtype=torch.float64)
        step[place] = size
        expected = (photons(step) - photons(-step)) / (2 * size)
        found = drawn["device", 0].changes[DEVICE][place]
        assert float((found - expected).norm() / expected.norm()) < 0.15  # edges are sharp beside pixels of 3 mm


def test_the_rows_of_a_procedure_keep_the_order_that_they_must(imagined: Imagined) -> None:
    rows = list(bound_rows(imagined))
    bounds = {(row["unknown"], row["images"]): torch.tensor([row.get(c, torch.nan) for c in TOTALS])
              for row in rows if row["what"] == BOUND}  # fmt: skip
    usual = bounds[USUAL, ALL_IMAGES]
    assert usual.isfinite().all()
    assert (usual > 0).all()
    ladder = [found for (_, images), found in bounds.items() if images == ALL_IMAGES]
    alone, light, _, shape, cameras, carm_known = ladder
    for more, less in ((light, alone), (usual, light), (shape, usual), (cameras, usual)):
        assert (more >= less * (1 - 1e-6)).all()
    known = ~carm_known.isnan()
    assert known.sum() == len(TOTALS) - 4  # views 2 and 3 have no error then
    assert (carm_known[known] <= usual[known] * (1 + 1e-6)).all()
    fewer = {images: found for (_, images), found in bounds.items() if images != ALL_IMAGES}
    assert list(fewer) == [
        *(f"without {kind} {view}" for view in (1, 2, 3) for kind in ("anatomy", "device")),
        "view 1 alone",
        "views 1 to 2",
    ]
    for found in fewer.values():
        there = ~found.isnan()
        assert (found[there] >= usual[there] * (1 - 1e-6)).all()
    for what in (NOISE, INFORMATION):
        shares = [row["relative_mm" if what == NOISE else "device_mm"] for row in rows if row["what"] == what]
        assert len(shares) == 6
        assert sum(shares) == pytest.approx(1)


def test_four_times_the_dose_halves_the_bounds_where_only_photons_are_noisy(
    coarse_root: Path, imagined: Imagined
) -> None:
    pure = replace(imagined.theatre.model, electronic_noise=0, open_beam_counts=1e12)
    found = []
    for dose in (1, 4):
        theatre = replace(imagined.theatre, model=replace(pure, dose_ugy=dose * pure.dose_ugy))
        images = tuple(image.information for image in simulated_images(theatre))
        row = next(iter(bound_rows(replace(imagined, theatre=theatre, images=images))))
        found.append(torch.tensor([row[column] for column in TOTALS]))
    torch.testing.assert_close(found[1], found[0] / 2, rtol=1e-4, atol=0)
    least = next(iter(bound_rows(imagined)))
    assert least["relative_mm"] > float(found[0][TOTALS.index("relative_mm")])


def test_what_the_bound_does_not_know_is_refused(imagined: Imagined, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="motion_mm: 2"):
        next(simulated_images(replace(imagined.theatre, model=replace(imagined.theatre.model, motion_mm=2))))
    with pytest.raises(InputError, match="no such condition"):
        limits("dose", tmp_path, 1, 0.78, "no_such", 0, lambda _: None)
    with pytest.raises(InputError, match="no such file"):
        limits("paper", tmp_path, 1, 0.78, None, 0, lambda _: None)

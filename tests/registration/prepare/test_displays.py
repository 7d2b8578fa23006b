"""One scene stored in every way: the images inside, their fields and the start from landmarks are the same."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pydicom
import pytest
import torch
import trimesh
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import ExplicitVRLittleEndian, XRayAngiographicImageStorage

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, CaseObject, Model, Start, View, read_case, write_case
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Circle, Display, write_image
from femoreg_torch.geometry import Camera, CArm, exp_se3, project_points, rotation_angle, transform_points
from femoreg_torch.registration.prepare.images import read_images
from femoreg_torch.registration.start.by_hand import start_by_landmarks
from femoreg_torch.registration.start.find import find_start

float64 = torch.float64
CAMERA = Camera(1000.0, (1.5, 1.4), (40, 50), (26.0, 18.0))  # as the source sees it; nothing of it is symmetric
LEFT_HALF = [  # an adult pelvis, LPS mm: FH, GSN, IOF, MOF, SPS, IPS, ASIS
    [90.0, -10, -80], [75, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120], [125, -75, -25]
]  # fmt: skip
RAW = 4 * torch.randint(250, 15000, (40, 50), generator=torch.Generator().manual_seed(0))
DISPLAYS = [
    Display(source, mirrored, turned)  # type: ignore[arg-type]
    for source, mirrored, turned in itertools.product(("anterior", "posterior"), (False, True), (0, 90, 180, 270))
]


def write_dicom(path: Path, pixels: torch.Tensor, photometric: str, **fields: object) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = XRayAngiographicImageStorage
    meta.MediaStorageSOPInstanceUID = "1.2.3"
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset = FileDataset(str(path), {}, file_meta=meta, preamble=b"\0" * 128)
    settings = {
        "SOPClassUID": meta.MediaStorageSOPClassUID,
        "SOPInstanceUID": "1.2.3",
        "Modality": "XA",
        "Rows": pixels.shape[0],
        "Columns": pixels.shape[1],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": photometric,
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 0,
        "PixelData": (pixels if photometric == "MONOCHROME2" else 65535 - pixels).to(torch.uint16).numpy().tobytes(),
    } | fields
    for name, value in settings.items():
        setattr(dataset, name, value)
    pydicom.dcmwrite(path, dataset)


def binned(raw: torch.Tensor, factor: int) -> torch.Tensor:
    """As a detector does it."""
    rows, columns = raw.shape
    return raw.reshape(rows // factor, factor, columns // factor, factor).sum((1, 3)) // factor**2


@pytest.mark.parametrize("display", DISPLAYS[1:], ids=str)
def test_pixels_of_the_c_arm_are_those_of_view_1_whoever_tells_its_display(tmp_path: Path, display: Display) -> None:
    """What stands in the view is not another thing than what stands on top."""
    write_image(tmp_path / "image.tif", display.to_stored(RAW).to(torch.uint16))
    case = case_of(tmp_path, display, "image.tif")
    in_view = replace(case, display=Display(), views=(replace(case.views[0], display=display),))
    other = tmp_path / "in_view"
    other.mkdir()
    write_case(other, in_view)
    again = read_case(other)
    assert again.display_of(0) == display
    assert again.carm == case.carm


def case_of(folder: Path, display: Display, image: str, camera: Camera = CAMERA, **told: object) -> Case:
    """The case as it comes back from its folder."""
    trimesh.creation.box((20, 20, 20)).export(folder / "block.stl")
    nominal = Start(camera1_from=torch.eye(4, dtype=float64))
    objects = {"block": CaseObject("block", model=Model(folder / "block.stl", 500.0), start=nominal)}
    carm = CArm(camera, (0.0, 0.0, 620.0), (0.0, 1.0, 0.0))
    view = View({"image": folder / image}, None, field=told.get("field"))  # type: ignore[arg-type]
    write_case(folder, Case(folder, carm, objects, views=(view,), display=display))
    case = read_case(folder)
    assert case.carm == carm
    assert case.display == display
    return case


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize("photometric", ["MONOCHROME1", "MONOCHROME2"])
@pytest.mark.parametrize("display", DISPLAYS, ids=str)
def test_images_and_fields_are_the_same_bit_by_bit(
    tmp_path: Path, display: Display, photometric: str, binning: int
) -> None:
    raw, camera = binned(RAW, binning), CAMERA.downsampled(binning)
    write_dicom(tmp_path / "view.dcm", binned(display.to_stored(RAW), binning), photometric)
    centre = display.pixels_to_stored(torch.tensor([20.0, 25.0]) / binning, camera).tolist()
    radius = 12.0 / binning
    case = case_of(tmp_path, display, "view.dcm", camera, field=Circle((centre[0], centre[1]), radius))
    images, fields, told = read_images(case)
    write_image(tmp_path / "plain.tif", raw.to(torch.uint16))
    field = Circle((20.0 / binning, 25.0 / binning), radius)
    plain, plain_fields, _ = read_images(case_of(tmp_path, Display(), "plain.tif", camera, field=field))
    assert torch.equal(images["image"][0], plain["image"][0])  # type: ignore[arg-type]
    assert torch.equal(fields["image"][0], plain_fields["image"][0])  # type: ignore[arg-type]
    assert told == ()


@pytest.mark.parametrize("display", [*DISPLAYS, Display("left"), Display("right", turned_deg=90)], ids=str)
def test_landmarks_in_the_stored_picture_start_from_every_side(tmp_path: Path, display: Display) -> None:
    camera = replace(CAMERA, pixel_mm=(0.5, 0.5), shape=(1500, 1400), principal_point_px=(600.0, 750.0))
    generator = torch.Generator().manual_seed(1)
    points = (torch.rand(14, 3, generator=generator, dtype=float64) - 0.5) * torch.tensor([220.0, 120.0, 180.0])
    forward, down = torch.tensor(display.beam, dtype=float64), torch.tensor([0.0, 0, -1], dtype=float64)
    upright = torch.eye(4, dtype=float64)
    upright[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward])
    upright[2, 3] = 640.0
    truth = exp_se3(torch.tensor([0.1, -0.15, 0.05, 4, -6, 10], dtype=float64)) @ upright
    stored = display.pixels_to_stored(project_points(camera, transform_points(truth, points)), camera)
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    carm = CArm(camera, (0.0, 0.0, 620.0), (0.0, 1.0, 0.0))
    case = Case(tmp_path, carm, {}, views=(View({}),), landmarks=landmarks, display=display)
    found = start_by_landmarks(case, "pelvis", dict(zip(HIP.landmark_names, stored, strict=True)))
    moved = transform_points(found.camera1_from_object, points) - transform_points(truth, points)
    assert moved.norm(dim=1).max() < 0.05
    kept = found.landmarks["FH-l"].pixel
    assert list(kept) == pytest.approx(stored[0].tolist())
    wrong = replace(case, display=Display(display.source, not display.mirrored, display.turned_deg))
    with pytest.raises(InputError, match="landmarks"):
        start_by_landmarks(wrong, "pelvis", dict(zip(HIP.landmark_names, stored, strict=True)))


def pelvis_under(folder: Path, display: Display, turn: torch.Tensor) -> tuple[Case, torch.Tensor, torch.Tensor]:
    """A case, its true pose, and where its landmarks are seen, 1.5 mm beside, by a camera that is turned (4, 4)."""
    camera = replace(CAMERA, pixel_mm=(0.5, 0.5), shape=(700, 600), principal_point_px=(300.0, 350.0))
    half = torch.tensor(LEFT_HALF, dtype=float64)
    points = torch.stack([half, half * torch.tensor([-1.0, 1, 1], dtype=float64)], 1).flatten(0, 1)
    forward, down = torch.tensor(display.beam, dtype=float64), torch.tensor([0.0, 0, -1], dtype=float64)
    truth = torch.eye(4, dtype=float64)
    truth[:3, :3] = turn[:3, :3] @ torch.stack([torch.linalg.cross(down, forward), down, forward])
    truth[:3, 3] = torch.tensor([5.0, -8, 700], dtype=float64) - truth[:3, :3] @ points.mean(0)
    noise = 3 * torch.randn(14, 2, generator=torch.Generator().manual_seed(2), dtype=float64)
    seen = display.pixels_to_stored(project_points(camera, transform_points(truth, points)) + noise, camera)
    carm = CArm(camera, (0.0, 0.0, 620.0), (0.0, 1.0, 0.0))
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    return Case(folder, carm, {}, (View({}),), HIP, landmarks=landmarks, display=display), truth, seen


@pytest.mark.parametrize("source", ["left", "right"])
@pytest.mark.parametrize("tilt_deg", [0, 40])
def test_from_a_side_landmarks_with_left_and_right_exchanged_are_told(
    tmp_path: Path, source: str, tilt_deg: float
) -> None:
    """A pelvis is its own mirror image, and 40° of tilt are those of a cross-table view."""
    tilt = exp_se3(torch.tensor([math.radians(tilt_deg), 0.05, 0, 0, 0, 0], dtype=float64))
    case, truth, seen = pelvis_under(tmp_path, Display(source), tilt)  # type: ignore[arg-type]
    found = start_by_landmarks(case, "pelvis", dict(zip(HIP.landmark_names, seen, strict=True)))
    turned = found.camera1_from_object[:3, :3] @ truth[:3, :3].mT
    assert torch.rad2deg(rotation_angle(turned)) < 4
    exchanged = dict(zip(HIP.landmark_names, seen.view(7, 2, 2).flip(1).flatten(0, 1), strict=True))
    with pytest.raises(InputError, match="with left and right exchanged they fit better"):
        start_by_landmarks(case, "pelvis", exchanged)


@pytest.mark.parametrize("source", ["left", "right"])
def test_from_a_side_the_networks_landmarks_with_left_and_right_exchanged_are_told(tmp_path: Path, source: str) -> None:
    case, truth, seen = pelvis_under(tmp_path, Display(source), torch.eye(4, dtype=float64))  # type: ignore[arg-type]
    camera, beam = case.carm.camera, case.display.beam
    seen = case.display.pixels_to_camera(seen, camera)
    ones = torch.ones(len(HIP.landmarks), dtype=float64)
    bones = torch.zeros(1 + len(HIP.bones), 96, 96)
    detection = Detection(seen, ones, 2 * ones, ones > 0, bones, camera, False)

    def start(found: Detection) -> torch.Tensor:
        image = torch.zeros(camera.shape)
        return find_start(case.landmarks, found, image, camera, None, HIP, beam=beam).camera_from_ct

    turned = start(detection)[:3, :3] @ truth[:3, :3].mT
    assert torch.rad2deg(rotation_angle(turned)) < 5
    exchanged = seen.view(7, 2, 2).flip(1).flatten(0, 1)
    with pytest.raises(InputError, match="with left and right exchanged they fit better"):
        start(replace(detection, pixels=exchanged))


@pytest.mark.parametrize("said", ["anterior", "posterior"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_view_from_a_side_that_the_case_takes_for_another_one_is_told(
    tmp_path: Path, said: str, mirrored: bool
) -> None:
    case, _, seen = pelvis_under(tmp_path, Display("left"), exp_se3(torch.zeros(6, dtype=float64)))
    wrong = replace(case, display=Display(said, mirrored))  # type: ignore[arg-type]
    exchanged = seen.view(7, 2, 2).flip(1).flatten(0, 1)
    for pixels in (seen, exchanged):
        with pytest.raises(InputError, match=r"Write `display: {source: (left|right)}`|too few usable|no usable pose"):
            start_by_landmarks(wrong, "pelvis", dict(zip(HIP.landmark_names, pixels, strict=True)))


@pytest.mark.parametrize(("yaw_deg", "tilt_deg"), [(-50, 0), (50, -20), (0, 65)])
def test_oblique_and_steep_views_of_the_side_that_the_case_says(
    tmp_path: Path, yaw_deg: float, tilt_deg: float
) -> None:
    """Nothing is said against a source that stands askew, as in inlet, outlet and oblique views."""
    tilt = exp_se3(torch.tensor([math.radians(tilt_deg), 0, 0, 0, 0, 0], dtype=float64))
    yaw = exp_se3(torch.tensor([0, math.radians(yaw_deg), 0, 0, 0, 0], dtype=float64))
    case, truth, seen = pelvis_under(tmp_path, Display("anterior"), tilt @ yaw)
    found = start_by_landmarks(case, "pelvis", dict(zip(HIP.landmark_names, seen, strict=True)))
    turned = found.camera1_from_object[:3, :3] @ truth[:3, :3].mT
    assert torch.rad2deg(rotation_angle(turned)) < 4


def test_a_header_against_the_case(tmp_path: Path) -> None:
    write_dicom(tmp_path / "view.dcm", RAW, "MONOCHROME2", DistanceSourceToDetector=1400)
    with pytest.raises(InputError, match=r"views\[0\]\.image: view\.dcm, DistanceSourceToDetector is 1400 mm"):
        read_images(case_of(tmp_path, Display(), "view.dcm"))
    write_dicom(tmp_path / "view.dcm", RAW, "MONOCHROME2", PositionerPrimaryAngle=5)
    with pytest.raises(InputError, match=r"patient's posterior side, but the case says right"):
        read_images(case_of(tmp_path, Display("right"), "view.dcm"))
    with pytest.raises(
        InputError, match=r"posterior side, .* as nothing is said\. Write `display: {source: posterior}`"
    ):
        read_images(case_of(tmp_path, Display(), "view.dcm"))
    for display in (Display("posterior"), Display(ignore_header=True), Display("right", ignore_header=True)):
        case = case_of(tmp_path, display, "view.dcm")
        assert case.display.ignore_header == display.ignore_header
        read_images(case)


def test_a_carm_from_the_header(tmp_path: Path) -> None:
    write_dicom(tmp_path / "view.dcm", RAW, "MONOCHROME2", DistanceSourceToDetector=990, ImagerPixelSpacing=[0.3, 0.2])
    case_of(tmp_path, Display(turned_deg=90), "view.dcm")
    text = (tmp_path / "case.yaml").read_text(encoding="utf-8")
    start, end = text.index("carm:"), text.index("display:")
    (tmp_path / "case.yaml").write_text(text[:start] + "carm: dicom\n" + text[end:], encoding="utf-8")
    camera = read_case(tmp_path).carm.camera
    assert (camera.sdd_mm, camera.pixel_mm, camera.shape) == (990, (0.2, 0.3), (50, 40))  # turned upright


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("display: {source: above}", r"display\.source: anterior or posterior or left or right was expected"),
        ("display: {turned: 45}", r"display\.turned: degrees clockwise, 0, 90, 180, 270, were expected, found 45"),
        ("display: {mirrored: 1}", r"display\.mirrored: true or false was expected"),
        ("display: {ignore_header: 1}", r"display\.ignore_header: true or false was expected"),
        ("display: {side: left}", r"display\.side: unknown key"),
    ],
)
def test_displays_that_cannot_be(tmp_path: Path, line: str, message: str) -> None:
    write_image(tmp_path / "view.tif", RAW.to(torch.uint16))
    case_of(tmp_path, Display(), "view.tif")
    path = tmp_path / "case.yaml"
    path.write_text(path.read_text(encoding="utf-8") + line + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_case(tmp_path)

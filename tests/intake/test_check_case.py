"""Some 25 broken cases with three to five faults each: every fault is told, each once, and nothing else."""

import json
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import nibabel
import numpy as np
import pytest
import torch
import trimesh
from intake_files import HEAD, case_content, landmarks, markups, ras_affine, write_content, write_files

from femoreg_torch.anatomy import HIP, label_table, load_anatomy
from femoreg_torch.case import read_case
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.intake import check_case
from femoreg_torch.intake.check_anatomy import SeenAnatomy, check_heads, check_landmarks
from femoreg_torch.intake.found import Found
from femoreg_torch.intake.volumes import ct_warnings
from femoreg_torch.registration import prepare_scene
from femoreg_torch.volume import BoneLabels, Volume, axis_aligned, read_ct, read_label_map
from femoreg_torch.volume.bones import nearest_voxel

PLANES_PX = 315  # of three planes of that CT: 60 voxels of 4 mm high, 420 pixels for 80 of them

Content = dict[str, Any]
Fault = tuple[Callable[[Content, Path], object], str]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("files") / "case")


def renamed(c: Content, folder: Path, **names: str) -> None:
    (folder / "landmarks.mrk.json").write_text(
        markups({names.get(k, k): v for k, v in landmarks().items()}), encoding="utf-8"
    )


def swapped(c: Content, folder: Path) -> None:
    other = {"l": "r", "r": "l"}
    (folder / "landmarks.mrk.json").write_text(
        markups({k[:-1] + other[k[-1]]: v for k, v in landmarks().items()}), encoding="utf-8"
    )


def moved(c: Content, folder: Path, name: str, to: tuple[float, ...]) -> None:
    (folder / "landmarks.mrk.json").write_text(markups(landmarks() | {name: to}), encoding="utf-8")


def few(c: Content, folder: Path) -> None:
    (folder / "landmarks.mrk.json").write_text(
        markups({k: landmarks()[k] for k in ("FH-l", "ASIS-l", "FH-r")}), encoding="utf-8"
    )


def flipped(c: Content, folder: Path) -> None:
    """Points of RAS in a file that says LPS."""
    (folder / "landmarks.mrk.json").write_text(
        markups({k: (-x, -y, z) for k, (x, y, z) in landmarks().items()}), encoding="utf-8"
    )


def relabelled(c: Content, folder: Path, old: int, new: int) -> None:
    image = nibabel.load(folder / "labels.nii.gz")
    values = np.asarray(image.dataobj).copy()
    values[values == old] = new
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), folder / "labels.nii.gz")


def relabelled_ball(folder: Path, old: int, new: int) -> None:
    """The femoral head goes to the hip bone, as some programs have it."""
    image = nibabel.load(folder / "labels.nii.gz")
    values = np.asarray(image.dataobj).copy()
    head = nibabel.affines.apply_affine(np.linalg.inv(ras_affine()), np.array(HEAD) * [-1, -1, 1])
    x, y, z = np.indices(values.shape)
    ball = (x - head[0]) ** 2 + (y - head[1]) ** 2 + (z - head[2]) ** 2 < 6**2
    values[ball & (values == old)] = new
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), folder / "labels.nii.gz")


def attenuation(c: Content, folder: Path) -> None:
    values = np.asarray(nibabel.load(folder / "ct.nii.gz").dataobj)
    nibabel.save(nibabel.Nifti1Image((values + 1000) * np.float32(2e-5), ras_affine()), folder / "ct.nii.gz")


def rescaled(c: Content, folder: Path, offset: int) -> None:
    """Beside a filled corner, and with something dense in it, so that its range is that of a CT."""
    values = np.asarray(nibabel.load(folder / "ct.nii.gz").dataobj) + np.int16(offset)
    values[0, 0], values[40, 25, 30] = -2000, 1500
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), folder / "ct.nii.gz")


def metres(c: Content, folder: Path) -> None:
    points = {name: tuple(v / 1000 for v in point) for name, point in landmarks().items()}
    (folder / "landmarks.mrk.json").write_text(markups(points), encoding="utf-8")


def centimetres(c: Content, folder: Path) -> None:
    points = {name: tuple(v / 10 for v in point) for name, point in landmarks().items()}
    (folder / "landmarks.mrk.json").write_text(markups(points), encoding="utf-8")


def masked(c: Content, folder: Path) -> None:
    cv2.imwrite(str(folder / "mask.png"), np.eye(20, dtype=np.uint8))
    c["views"][1].update(field="mask.png")


def negative(c: Content, folder: Path) -> None:
    cv2.imwrite(str(folder / "view2.tif"), -np.random.default_rng(3).uniform(1, 9, (48, 40)).astype(np.float32))
    c["views"][1].update(anatomy="view2.tif", intensity="raw")


def open_mesh(c: Content, folder: Path) -> None:
    import trimesh

    mesh = trimesh.load(folder / "device.stl")
    trimesh.Trimesh(mesh.vertices, mesh.faces[3:]).export(folder / "device.stl")


def truth_of_two_views(c: Content, folder: Path) -> None:
    pose = np.eye(4).tolist()
    poses = {"camera_from_pelvis": [pose, pose], "camera1_from_femur": pose, "camera1_from_device": pose}
    (folder / "truth.json").write_text(json.dumps(poses), encoding="utf-8")
    c.update(truth="truth.json")


FAULTS: dict[str, Fault] = {
    "side": (lambda c, f: c.update(side="links"), r"case\.yaml, .*side: left or right was expected, found 'links'"),
    "extra key": (lambda c, f: c.update(sides="left"), r"case\.yaml, .*sides: unknown key"),
    "extra ct key": (lambda c, f: c["ct"].update(lables="x"), r"ct\.lables: unknown key"),
    "no ct": (lambda c, f: c["ct"].update(image="none.nii.gz"), r"ct\.image: 'none\.nii\.gz': no such file"),
    "no labels": (lambda c, f: c["ct"].pop("labels"), r"ct\.labels: is missing, a label map"),
    "table": (lambda c, f: c["ct"].update(bones="totalseg"), r"ct\.bones: .*totalseg"),
    "no femur": (lambda c, f: relabelled(c, f, 5, 0), r"label map: no voxel carries the label 5, the femur_left"),
    "merged": (
        lambda c, f: relabelled(c, f, 1, 5),
        r"label map: .*ASIS-l of the hip_left lie on the femur_left: does the label map hold both as one",
    ),
    "head in hip": (
        lambda c, f: relabelled_ball(f, 5, 1),
        r"label map: FH-l of the femur_left lie on the hip_left",
    ),
    "no intercept": (lambda c, f: rescaled(c, f, 1024), r"CT: in the median what lies beside the bones has 10\d\d HU"),
    "mask": (masked, r"views\[1\]\.field: it is 20 × 20 pixels, but the C-arm has 48 × 40"),
    "no field": (
        lambda c, f: c["views"][2].update(field={"circle": {"centre": [500, 500], "radius": 3}}),
        r"views\[2\]\.field: exposes no pixel",
    ),
    "no grid": (
        lambda c, f: c["views"][2].update(grid={"image": "view1.png", "pitch_mm": 10}),
        r"views\[2\]\.grid",
    ),
    "negative": (negative, r"views\[1\]\.anatomy: view2\.tif: no pixel is positive"),
    "turned": (lambda c, f: c["views"][0].update(display={"turned": 45.0}), r"display\.turned: degrees clockwise"),
    "attenuation": (attenuation, r"ct\.nii\.gz: values run from 0 to .* Hounsfield"),
    "bad name": (lambda c, f: renamed(c, f, **{"GSN-l": "notch"}), r"landmarks\.mrk\.json: unknown landmark 'notch'"),
    "swapped": (swapped, r"landmarks: left and right are swapped: .*Exchange the endings"),
    "outside": (lambda c, f: moved(c, f, "GSN-r", (-60, 380, 10)), r"landmark GSN-r at .* lies outside the CT"),
    "stray": (lambda c, f: moved(c, f, "ASIS-l", (10, -90, -110)), r"landmarks: ASIS-l lie far from the bones"),
    "flipped": (flipped, r"landmarks: FH-l, .* fit the bones better with x and y negated: the file holds RAS"),
    "plan number": (lambda c, f: c["plan"].update(entry_point=[1, 2]), r"plan\.entry_point: a point \[x, y, z\]"),
    "plan far": (
        lambda c, f: c["plan"].update(entry_point=[20, -80, 90]),
        r"plan: the entry point \(20\.0, -80\.0, 90\.0\)",
    ),
    "plan side": (
        lambda c, f: c["plan"].update(entry_point=[-148, 0, -70]),
        r"entry point lies on the femur_right, but",
    ),
    "plan turned": (
        lambda c, f: c["plan"].update(entry_point=list(HEAD), target=[148, 0, -70]),
        r"plan: the entry point lies nearer to the femoral head than the target",
    ),
    "no model": (
        lambda c, f: c["device"].update(model="device.step"),
        r"device\.model: 'device\.step': no such file",
    ),
    "open mesh": (open_mesh, r"device\.stl: .*not closed|device\.stl: .*hole|device\.stl: .*closed"),
    "two materials": (lambda c, f: c["device"].update(material="steel"), r"device\.material: `hu` is given too"),
    "no base": (lambda c, f: c["device"]["points"].pop("base"), r"device\.points\.base: is missing"),
    "tip word": (lambda c, f: c["device"]["points"].update(tip="x"), r"device\.points\.tip: a point"),
    "guide": (lambda c, f: c["device"].update(start={"guide": "upwards"}), r"device\.start: guide: one of along"),
    "no start": (lambda c, f: c["device"].pop("start"), r"device\.camera1_from_device: is missing, the nominal"),
    "carm": (lambda c, f: c.update(carm="siemens"), r"case\.yaml, .*carm: .*siemens"),
    "view missing": (lambda c, f: (f / "view2.png").unlink(), r"views\[1\]\.anatomy: .*no such file"),
    "view shape": (
        lambda c, f: cv2.imwrite(str(f / "view3.png"), np.arange(400, dtype=np.uint16).reshape(20, 20) * 9),
        r"views\[2\]\.anatomy: it is 20 × 20 pixels, but the C-arm has 48 × 40",
    ),
    "view twice": (
        lambda c, f: shutil.copy(f / "view1_device.png", f / "view3_device.png"),
        r"views\[2\]\.device: the same image as views\[0\]\.device",
    ),
    "view text": (
        lambda c, f: (f / "view1.png").write_text("text", encoding="utf-8"),
        r"view1\.png: cannot be read as a PNG",
    ),
    "intensity": (lambda c, f: c["views"][1].update(intensity="dark"), r"views\[1\]\.intensity: raw or log"),
    "field": (
        lambda c, f: c["views"][0].update(field={"circle": {"centre": [1, 2], "radius": -3}}),
        r"radius: a positive",
    ),
    "version": (lambda c, f: c.update(version=7), r"version: this FemoReg Torch reads versions 1 and 2, found 7"),
    "truth": (truth_of_two_views, r"truth\.json, camera_from_pelvis: 2 poses, but the case has 3 views"),
    "no views": (lambda c, f: c.update(views=[]), r"views: empty"),
}

BROKEN = [
    ("side", "no ct", "view missing"),
    ("extra key", "extra ct key", "table", "carm"),
    ("no labels", "bad name", "tip word", "no start"),
    ("attenuation", "view shape", "two materials"),
    ("swapped", "plan far", "intensity"),
    ("outside", "no model", "view twice"),
    ("stray", "view text", "guide"),
    ("bad name", "open mesh", "field"),
    ("plan number", "no base", "view missing", "view shape"),
    ("plan side", "view twice", "extra key"),
    ("plan turned", "no start", "carm"),
    ("no femur", "view text", "intensity", "field"),
    ("no ct", "bad name", "guide"),
    ("side", "flipped", "open mesh"),
    ("table", "outside", "plan turned", "no base"),
    ("no views", "two materials", "stray"),
    ("attenuation", "tip word", "extra key", "field"),
    ("no labels", "no model", "intensity", "view twice"),
    ("extra ct key", "plan side", "view shape", "guide"),
    ("no femur", "swapped", "carm", "view text"),
    ("merged", "mask", "no base"),
    ("head in hip", "no field", "no model"),
    ("no intercept", "negative", "guide"),
    ("no grid", "turned", "no model"),
    ("version", "truth", "side", "carm"),
]


@pytest.mark.parametrize("names", BROKEN, ids=[" + ".join(names) for names in BROKEN])
def test_every_fault_of_a_broken_case_is_told_at_once(files: Path, tmp_path: Path, names: tuple[str, ...]) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    for name in names:
        FAULTS[name][0](content, folder)
    write_content(folder, content)
    found = check_case(folder, find_start=False)
    for name in names:
        told = [problem for problem in found.problems if re.search(FAULTS[name][1], problem)]
        assert len(told) == 1, f"{name}: {found.problems}"
    assert len(found.problems) == len(names), found.problems
    assert all("\n" not in problem for problem in found.problems)
    # what could be read is drawn: three planes of the CT, then the images, three in a row
    planes = 0 if {"no ct", "attenuation"} & set(names) else PLANES_PX
    unread = {"view missing": 1, "view text": 1, "intensity": 2}  # images: the last says nothing sure of a whole view
    missing = sum(n for name, n in unread.items() if name in names)
    rows = 0 if "no views" in names else -(-(6 - missing) // 3)
    assert found.picture is not None
    assert found.picture.shape[0] == planes + 300 * rows + (12 if planes and rows else 0)
    assert found.picture.max() > 200


def test_ids_of_two_bones_that_are_exchanged_are_told_as_that(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    ids = {bone: of[0] for bone, of in label_table("femoreg").items()}
    content["ct"].update(bones=ids | {"hip_left": ids["femur_left"], "femur_left": ids["hip_left"]})
    write_content(folder, content)
    told = [problem for problem in check_case(folder, find_start=False).problems if problem.startswith("label map")]
    assert told == [
        "label map: landmarks of the hip_left lie on the femur_left, and those of the femur_left on the hip_left. "
        "Exchange their ids in `ct.bones`."
    ]


def test_there_are_25_with_several_faults_each_and_all_faults_occur() -> None:
    assert len(BROKEN) == 25
    assert min(map(len, BROKEN)) >= 3
    assert {name for names in BROKEN for name in names} == set(FAULTS)


def test_a_right_case_has_no_problem_and_is_drawn(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    found = check_case(folder, find_start=False)
    assert found.problems == ()
    assert found.picture is not None
    assert found.picture.shape[2] == 3
    assert main(["check", str(folder), "--fast", "--out", str(tmp_path / "check.png")]) == 0
    assert cv2.imread(str(tmp_path / "check.png")).shape == found.picture.shape
    assert "tip starts 20 mm from the entry point" in capsys.readouterr().out
    content = case_content()
    content["side"] = "right"
    write_content(folder, content)
    assert main(["check", str(folder), "--fast", "--out", str(tmp_path / "check.png")]) == 1
    assert "but `side` is right" in capsys.readouterr().out


def test_swapped_bones_are_told(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    ids = {"hip_left": 2, "hip_right": 1, "sacrum": 4, "femur_left": 6, "femur_right": 5}
    content["ct"]["bones"] = ids
    write_content(folder, content)
    problems = check_case(folder, find_start=False).problems
    assert any("hip_left lies to the right of hip_right" in one for one in problems)
    assert any("femur_left lies to the right of femur_right" in one for one in problems)
    # landmarks that were right are not to be exchanged as well
    assert any("landmarks: left and right are swapped" in one and "mend it first" in one for one in problems)
    assert not any("Exchange the endings" in one for one in problems)


def test_the_registration_refuses_swapped_sides_and_tells_what_was_done_to_a_label_map(
    files: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    image = nibabel.load(folder / "labels.nii.gz")
    labels = np.asarray(image.dataobj)
    nibabel.save(image.slicer[2:, :, 1:], folder / "labels.nii.gz")
    notes = prepare_scene(read_case(folder)).missing
    assert any("labels.nii.gz has a grid of its own (4 × 4 × 4 mm): it was resampled" in note for note in notes)
    moved = image.affine.copy()
    moved[:3, 3] += 2
    nibabel.save(nibabel.Nifti1Image(labels, moved), folder / "labels.nii.gz")
    assert any("was the origin taken for a corner?" in one for one in prepare_scene(read_case(folder)).contradictions)
    swapped({}, folder)
    with pytest.raises(InputError, match="landmarks: left and right are swapped"):
        prepare_scene(read_case(folder))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"MOF-l": "MOF-r", "MOF-r": "MOF-l"}, "MOF-l, MOF-r lie on the other side. Exchange"),
        ({"GSN-r": "GSN-l"}, "GSN-r lies on the other side. Exchange"),
        (0.1, "are they in cm"),
    ],
)
def test_the_registration_refuses_landmarks_on_other_bones(
    change: dict[str, str] | float, told: str, files: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    at = landmarks()
    if isinstance(change, dict):
        at |= {name: at[other] for name, other in change.items()}
    else:
        at = {name: tuple(change * x for x in point) for name, point in at.items()}
    (folder / "landmarks.mrk.json").write_text(markups(at), encoding="utf-8")
    with pytest.raises(InputError, match=told):
        prepare_scene(read_case(folder))
    assert any(told in one for one in check_case(folder, find_start=False).problems)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (centimetres, r"landmarks: .* lie on no bone, but would ten times as far from the origin: are they in cm\?"),
        (metres, r"landmarks: FH-l, .* lie within 2 mm of the origin: are they in metres\?"),
        (lambda c, f: c.update(version="2"), r"version: .* found '2'\. Take the quotes away"),
    ],
)
def test_what_mends_all_at_once_is_told(
    files: Path, tmp_path: Path, change: Callable[[Content, Path], object], told: str
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    change(content, folder)
    write_content(folder, content)
    assert any(re.search(told, problem) for problem in check_case(folder, find_start=False).problems)


def test_what_is_no_case_is_told(tmp_path: Path) -> None:
    assert "holds no case.yaml" in check_case(tmp_path).problems[0]
    (tmp_path / "case.yaml").write_text("- a list", encoding="utf-8")
    assert "a mapping of keys and values was expected" in check_case(tmp_path).problems[0]


def test_warnings_of_a_ct(files: Path) -> None:
    ct = read_ct(files / "ct.nii.gz")
    labels = read_label_map(files / "labels.nii.gz")
    assert ct.data.shape == labels.data.shape
    told = ct_warnings(ct)
    assert any("coarse voxels (4 × 4 × 4 mm)" in one for one in told)
    assert not any("air" in one or "cut" in one for one in told)
    sagittal = type(ct)(ct.data, torch.diag(torch.tensor([2.5, 0.9, 0.9, 1.0]).double()))
    assert not any("coarse" in one for one in ct_warnings(sagittal))  # slices may be thicker than pixels
    inner = ct.data[:, 15:35, 8:70].contiguous()
    inner[:2] = -100  # fat
    inside = type(ct)(inner, ct.lps_from_index)
    told = ct_warnings(inside)
    assert any("hardly any air" in one for one in told)
    metal = ct.with_data(ct.data.clone())
    metal.data[30:34, 20:24, 40:44] = 3000
    assert any("metal" in one for one in ct_warnings(metal))
    padded = ct.with_data(torch.where(torch.arange(len(ct.data))[:, None, None] < 2, -32768.0, ct.data.float()))
    assert any("seems to be filled with -32768" in one for one in ct_warnings(padded))
    cut = type(ct)(ct.data[:, :, 20:].contiguous(), ct.lps_from_index)
    assert any("bone is cut at the right face" in one for one in ct_warnings(cut))


@pytest.mark.parametrize(
    ("unit", "tip", "told"), [(1.0, -75.0, 0), (1.0, -95.0, 0), (1 / 25.4, -75.0, 2), (1.0, -120.0, 1)]
)
def test_a_point_beside_the_model_is_told(files: Path, tmp_path: Path, unit: float, tip: float, told: int) -> None:
    """A drill may stand out of its sleeve; a model in inches, or with another origin, leaves its points beside it."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    trimesh.creation.cylinder(radius=4 * unit, height=150 * unit, sections=12).export(folder / "device.stl")
    content = case_content()
    content["device"]["points"] = {"tip": [0, 0, tip], "base": [0, 0, 50], "center": [0, 0, 0]}
    write_content(folder, content)
    warnings = [
        each for each in check_case(folder, find_start=False).warnings if "outside the box of its model" in each
    ]
    assert len(warnings) == told, warnings


@pytest.mark.parametrize(
    ("points", "told"),
    [({"tip": [0, 0, -75]}, None), ({"tip": [0, 0, -63]}, "before"), ({"tip": [0, 0, -63], "end": [0, 0, -75]}, None)],
)
def test_a_tip_that_is_no_end_of_its_model_is_told(
    files: Path, tmp_path: Path, points: dict[str, list[int]], told: str | None
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    trimesh.creation.cylinder(radius=2, height=150, sections=12).export(folder / "device.stl")
    content = case_content()
    content["device"]["points"] = {"base": [0, 0, 50], "center": [0, 0, 0], **points}
    write_content(folder, content)
    found = check_case(folder, find_start=False)
    assert not found.problems
    warnings = [each for each in found.warnings if "the end of its model" in each]
    assert len(warnings) == (told is not None), warnings
    assert told is None or f"12.0 mm {told} the end" in warnings[0]


@pytest.mark.parametrize(("order", "told"), [((1, 2, 3), 0), ((1, 3, 2), 2), ((2, 3, 1), 3)])
def test_exchanged_images_are_told(files: Path, tmp_path: Path, order: tuple[int, ...], told: int) -> None:
    """Each view shows lumps of its own; the images with the device show them darker, with a bar across."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    for view in (1, 2, 3):
        lumps = cv2.GaussianBlur(np.random.default_rng(view).normal(size=(48, 40)), (0, 0), 2)
        image = 30000 * np.exp(lumps / lumps.std() / 4)
        cv2.imwrite(str(folder / f"view{view}.png"), image.astype(np.uint16))
        image[20:26] *= 0.3
        cv2.imwrite(str(folder / f"view{order[view - 1]}_device.png"), (0.7 * image).astype(np.uint16))
    write_content(folder, case_content())
    warnings = [each for each in check_case(folder, find_start=False).warnings if "exchanged?" in each]
    assert len(warnings) == told, warnings


def test_a_device_image_that_was_inverted_is_told_as_that(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    for view in (1, 2, 3):
        lumps = cv2.GaussianBlur(np.random.default_rng(view).normal(size=(48, 40)), (0, 0), 2)
        image = (30000 * np.exp(lumps / lumps.std() / 4)).astype(np.uint16)
        cv2.imwrite(str(folder / f"view{view}.png"), image)
        cv2.imwrite(str(folder / f"view{view}_device.png"), 65535 - image if view == 2 else image - 1)
    write_content(folder, case_content())
    warnings = [each for each in check_case(folder, find_start=False).warnings if each.startswith("views[1].device")]
    assert len(warnings) == 1, warnings
    assert "looks like the negative of views[1].anatomy" in warnings[0]


@pytest.mark.parametrize("intensity", ["raw", "log"])
@pytest.mark.parametrize("exposure", [0.5, 1.0, 1.8])
def test_images_with_and_without_the_device_that_are_exchanged_are_told(
    files: Path, tmp_path: Path, intensity: str, exposure: float
) -> None:
    """Also where those with the device are exposed more or less; a part that moved between both is no device."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)

    def told(names: tuple[str, str], moved: bool = False, views: tuple[int, ...] = (1, 2, 3)) -> list[str]:
        for view in views:
            lumps = cv2.GaussianBlur(np.random.default_rng(view).normal(size=(48, 40)), (0, 0), 2)
            attenuation = 1.2 + lumps / lumps.std() / 3
            both = attenuation + 0.8 * (np.arange(40) // 3 == 5)
            attenuation = attenuation + 0.8 * (np.arange(40) // 3 == 8) * moved
            for name, depth in zip(names, (attenuation, both - np.log(exposure)), strict=True):
                values = 20000 * np.exp(-depth) if intensity == "raw" else 5000 + 8000 * depth
                cv2.imwrite(str(folder / f"view{view}{name}.png"), values.clip(0, 65535).astype(np.uint16))
        content = case_content()
        content["views"] = [view | {"intensity": intensity} for view in content["views"]]
        write_content(folder, content)
        return [each for each in check_case(folder, find_start=False).warnings if "exchanged?" in each]

    assert told(("", "_device")) == []
    assert told(("", "_device"), moved=True) == []
    (line,) = told(("_device", ""))
    assert line.startswith("views[0], views[1], views[2]: `anatomy` shows something dense that `device` lacks")
    told(("", "_device"))
    (line,) = told(("_device", ""), views=(2,))
    assert line.startswith("views[1]: `anatomy` shows something dense that `device` lacks")


def test_few_landmarks_are_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    few(content, folder)
    write_content(folder, content)
    checked = check_case(folder, find_start=False)
    assert sum("landmarks: 3 of them; with fewer than 4 the start" in warning for warning in checked.warnings) == 1
    assert checked.problems == ()


def test_of_few_landmarks_those_of_the_cases_own_anatomy_are_named(tmp_path: Path) -> None:
    """A knee has no femoral head to be placed, and its anatomy no outlines that a start could hang on."""
    (tmp_path / "knee.yaml").write_text(
        "bones: {femur: {mirror: femur, colour: [255, 60, 100], names: [distal femur]}}\n"
        "groups: {}\n"
        "landmarks:\n"
        "  ME: {bone: femur, mirror: ME, spread_mm: 2.0, means: medial epicondyle}\n"
        "  LE: {bone: femur, mirror: LE, spread_mm: 2.0, means: lateral epicondyle}\n"
        "outline: {compare: [], hidden_by: []}\n",
        encoding="utf-8",
    )
    told = []
    for anatomy in (load_anatomy(tmp_path / "knee.yaml"), None, HIP):
        found = Found()
        check_landmarks(SeenAnatomy(landmarks={"ME": torch.zeros(3)}, anatomy=anatomy), found)
        told += found.warnings
    assert told[:2] == [
        "landmarks: 1 of them; a start pose by landmarks needs 4. Place more of LE.",
        "landmarks: 1 of them; a start pose by landmarks needs 4.",
    ]
    assert "outlines of the bones. Place more of FH-l, FH-r," in told[2]


def test_logarithms_that_the_case_takes_for_intensities_are_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    shown = np.random.default_rng(1).uniform(0.5, 6, (48, 40)).astype(np.float32)
    cv2.imwrite(str(folder / "view1.tif"), shown)
    content = case_content()
    content["views"][0] |= {"anatomy": "view1.tif", "intensity": "raw"}
    write_content(folder, content)
    told = "view1.tif looks like logarithms already, but the case says `intensity: raw`: bone is to be dark in it"
    assert told in check_case(folder, find_start=False).warnings
    content["views"][0]["intensity"] = "log"
    write_content(folder, content)
    assert told not in check_case(folder, find_start=False).warnings


@pytest.mark.parametrize(("change", "told"), [
    (lambda c, f: relabelled(c, f, 1, 5), "lie on the femur_left"),
    (lambda c, f: rescaled(c, f, 1024), "is the rescale of the scanner applied"),
    (lambda c, f: negative(c, f), r"view2\.tif: no pixel is positive"),
])  # fmt: skip
def test_the_registration_refuses_what_would_be_a_wrong_pose(
    files: Path, tmp_path: Path, change: Callable[[Content, Path], object], told: str
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    change(content, folder)
    write_content(folder, content)
    with pytest.raises(InputError, match=told):
        prepare_scene(read_case(folder))


def test_a_label_map_of_half_the_patient_is_no_fault(files: Path, tmp_path: Path) -> None:
    """Landmarks of bones that nobody segmented lie on none."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    for label in (2, 6):
        relabelled(content, folder, label, 0)
    write_content(folder, content)
    assert check_case(folder, find_start=False).problems == ()
    assert prepare_scene(read_case(folder)).missing == ()


def test_a_displaced_label_map_is_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    told = "label map: would lie on the bright bones of the CT if it were moved by"
    assert not any(told in warning for warning in check_case(folder, find_start=False).warnings)
    image = nibabel.load(folder / "labels.nii.gz")
    affine = ras_affine()
    affine[2, 3] += 8
    nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj), affine), folder / "labels.nii.gz")
    assert any(f"{told} (0, 0, -8)" in warning for warning in check_case(folder, find_start=False).warnings)


def test_many_pixels_below_zero_are_told(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    raw = np.random.default_rng(1).uniform(100, 900, (48, 40)).astype(np.float32)
    for taken_off, told in ((0, False), (400, True)):
        cv2.imwrite(str(folder / "view1.tif"), raw - taken_off)
        content = case_content()
        content["views"][0] |= {"anatomy": "view1.tif"}
        write_content(folder, content)
        warnings = check_case(folder, find_start=False).warnings
        assert any("of its pixels below 0" in warning for warning in warnings) == told
        assert any("of its pixels below 0" in note for note in prepare_scene(read_case(folder)).missing) == told


def test_a_device_that_starts_beyond_the_beam_is_a_problem(files: Path, tmp_path: Path) -> None:
    """A pose in metres: half a millimetre from the source."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    for depth, problems in ((500.0, 0), (0.5, 1), (-500.0, 1)):
        content = case_content()
        pose = np.eye(4)
        pose[2, 3] = depth
        content["device"] = {k: v for k, v in content["device"].items() if k in ("model", "hu", "material", "points")}
        content["device"]["camera1_from_device"] = pose.tolist()
        write_content(folder, content)
        found = check_case(folder, find_start=False)
        assert len(found.problems) == problems, found.problems
        assert all("the start pose puts device" in problem for problem in found.problems)


def test_a_beam_as_no_carm_has_it_is_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    for factor, told in ((1.0, False), (0.1, True), (10.0, True)):
        content = case_content()
        content["carm"] = {"sdd_mm": 1000 * factor, "pixel_mm": [4, 4], "shape": [48, 40]}
        write_content(folder, content)
        warnings = check_case(folder, find_start=False).warnings
        assert any("Are source distance and pixel size in mm?" in warning for warning in warnings) == told


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, None),
        ({"principal_point_px": [19.5, 23.5], "isocentre_mm": [0, 0, 620]}, None),
        ({"principal_point_px": [78, 94]}, "principal point at column 78 and row 94 of 40 × 48"),
        ({"isocentre_mm": [0, 0, 6200]}, "isocentre 6200 mm from the source"),
        ({"isocentre_mm": [0, 0, 0.62]}, "isocentre 0.62 mm from the source"),
        ({"isocentre_mm": [620, 0, 0]}, "isocentre 0 mm from the source"),
    ],
)
def test_a_principal_point_or_an_isocentre_as_no_carm_has_it_is_a_warning(
    change: dict[str, object], words: str | None, files: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    content["carm"] = {"sdd_mm": 1000, "pixel_mm": [4, 4], "shape": [48, 40]} | change
    write_content(folder, content)
    warnings = check_case(folder, find_start=False).warnings
    told = [one for one in warnings if "principal point" in one or "isocentre" in one]
    assert told == [] if words is None else (len(told) == 1 and words in told[0]), told


def test_two_views_of_one_pose_are_told(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    for view in content["views"]:
        view["camera_from_camera1"] = np.eye(4).tolist()
    write_content(folder, content)
    warnings = check_case(folder, find_start=False).warnings
    assert "views[1] and views[2] are given one and the same pose of the C-arm" in warnings


def test_bones_as_light_as_foam_are_a_warning(files: Path, tmp_path: Path) -> None:
    """An intercept of −1024 that is applied twice; bones of foam for courses are as light, and may be registered."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    rescaled(content, folder, -1024)
    values = np.asarray(nibabel.load(folder / "ct.nii.gz").dataobj).copy()
    values[np.random.default_rng(0).random(values.shape) < 0.02] = 600
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), folder / "ct.nii.gz")
    write_content(folder, content)
    told = "CT: in the median the bones of the label map have -424 HU"
    checked = check_case(folder, find_start=False)
    assert checked.problems == ()
    assert any(told in warning for warning in checked.warnings)
    assert any(told in note for note in prepare_scene(read_case(folder)).missing)


def test_a_bone_of_soft_tissue_is_told_by_check_and_registration(files: Path, tmp_path: Path) -> None:
    """Its id is that of a muscle: the label of the sacrum is given to what lies in front of it."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    image = nibabel.load(folder / "labels.nii.gz")
    values = np.asarray(image.dataobj)
    number = label_table("femoreg")["sacrum"][0]
    muscle = np.where(values == number, 0, values)
    muscle[np.roll(values == number, 20, 1) & (muscle == 0)] = number
    nibabel.save(nibabel.Nifti1Image(muscle, ras_affine()), folder / "labels.nii.gz")
    for notes in (check_case(folder, find_start=False).warnings, prepare_scene(read_case(folder)).missing):
        assert sum(note.startswith("label map: sacrum (40 and") for note in notes) == 1


@pytest.mark.parametrize(
    ("scale", "told"),
    [
        ((1.0, 1.0, 1.0), []),
        ((1.6, 1.6, 1.6), ["the left femoral head has a radius", "the right femoral head has a radius"]),
        ((1.0, 1.0, 1.3), ["both femoral heads of the label map measure"]),
    ],
)
def test_heads_that_are_too_large_or_too_long_are_told(files: Path, scale: tuple[float, ...], told: list[str]) -> None:
    """As where the voxels are not as large as the header says."""
    table = label_table("femoreg")
    labels = read_label_map(files / "labels.nii.gz")
    scaled = torch.diag(torch.tensor([*scale, 1.0], dtype=torch.float64)) @ labels.lps_from_index
    found = Found()
    bones = BoneLabels(Volume(labels.data, scaled), {name: ids[0] for name, ids in table.items()})
    check_heads(SeenAnatomy(bones=bones, anatomy=HIP), found)
    assert [warning[: len(start)] for warning, start in zip(found.warnings, told, strict=True)] == told


@pytest.mark.parametrize(
    ("scale", "told"),
    [(0.1, ["that is 32 mm long at most", "left femoral head has a radius of 2.1 mm"]), (0.02, ["that is 6 mm long"])],
)
def test_a_hip_of_no_size_is_told_by_its_size(files: Path, tmp_path: Path, scale: float, told: list[str]) -> None:
    """As in cm, or less: too small for the surface of a bone, which had ended in a traceback."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    for name in ("ct.nii.gz", "labels.nii.gz"):
        image = nibabel.load(folder / name)
        smaller = np.diag([scale, scale, scale, 1]) @ ras_affine()
        nibabel.save(nibabel.Nifti1Image(np.asarray(image.dataobj), smaller), folder / name)
    marks = {name: tuple(scale * v for v in point) for name, point in landmarks().items()}
    (folder / "landmarks.mrk.json").write_text(markups(marks), encoding="utf-8")
    content = case_content()
    content["plan"]["entry_point"] = [scale * v for v in content["plan"]["entry_point"]]
    write_content(folder, content)
    warnings = check_case(folder, find_start=False).warnings
    assert all(any(words in warning for warning in warnings) for words in told)
    with suppress(InputError):  # the smaller one, of which nothing is left on voxels of 1 mm
        prepare_scene(read_case(folder))


def test_vertebrae_that_a_ct_does_not_show_are_no_warning(files: Path, tmp_path: Path) -> None:
    """A hip bone that nobody labelled is one."""
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    write_content(folder, case_content())
    relabelled({}, folder, label_table("femoreg")["hip_right"][0], 0)
    found = check_case(folder, find_start=False)
    assert "not in labels.nii.gz: vertebrae" in found.facts
    absent = [warning for warning in found.warnings if "no voxel of" in warning]
    assert len(absent) == 1
    assert "the hip_right: right if the CT shows none" in absent[0]


def warned(folder: Path, content: Content) -> str:
    write_content(folder, content)
    checked = check_case(folder, find_start=False)
    assert checked.problems == ()
    return "\n".join(checked.warnings)


def test_points_beside_their_bones_are_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    for told in ("beside the", "outside the femur", "from the middle of the sphere"):
        assert told not in warned(folder, content)
    moved(content, folder, "ASIS-r", (-90.0, -33.0, 58.0))
    assert re.search(r"ASIS-r lies 1\d mm beside the hip_right: look at it", warned(folder, content))
    moved(content, folder, "FH-l", (HEAD[0], HEAD[1], HEAD[2] + 10.0))
    assert "FH-l lies 10 mm from the middle of the sphere that fits the femoral head" in warned(folder, content)
    moved(content, folder, "FH-l", HEAD)
    x, y, z = content["plan"]["entry_point"]
    content["plan"]["entry_point"] = [x + 10.0, y, z]
    assert "mm outside the femur: look at it" in warned(folder, content)


def test_a_bone_with_landmarks_that_the_label_map_does_not_tell_is_a_warning(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "case"
    shutil.copytree(files, folder)
    content = case_content()
    content["ct"]["bones"] = {"hip_left": [1], "sacrum": [4], "femur_left": [5], "femur_right": [6]}
    told = "label map: does not tell the hip_right, which landmarks lie on (GSN-r, IOF-r, MOF-r, SPS-r, IPS-r, ASIS-r)"
    assert told in warned(folder, content)
    assert any(told in remark for remark in prepare_scene(read_case(folder)).missing)
    content["ct"]["bones"] |= {"hip_right": [2]}
    assert "does not tell" not in warned(folder, content)


def test_how_near_a_bone_is_does_not_hang_on_the_voxels() -> None:
    """10 mm beside a bone, on voxels of 0.5 and of 5 mm; 40 mm beside it is near on none."""
    for mm in (0.5, 5.0):
        data = torch.zeros(int(100 / mm), 4, 4, dtype=torch.uint8)
        data[: int(20 / mm)] = 1
        labels = Volume(data, axis_aligned((mm, mm, mm), (0.0, 0.0, 0.0)))
        found = nearest_voxel(labels, [1], torch.tensor([0.0, 0.0, 30.0], dtype=torch.float64))
        assert found is not None
        assert found[1] == pytest.approx(10.5 if mm == 0.5 else 15.0, abs=mm)
        assert nearest_voxel(labels, [1], torch.tensor([0.0, 0.0, 60.0], dtype=torch.float64)) is None


def test_a_picture_that_cannot_be_written_is_told_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "case.yaml").write_text("not: read\n", encoding="utf-8")
    assert main(["check", str(tmp_path / "case"), "--out", str(tmp_path / "none" / "check.png")]) == 2
    assert "there is no folder" in capsys.readouterr().err

"""Anatomies and label tables as data."""

from pathlib import Path

import pytest

from femoreg_torch.anatomy import HIP, bone_of_name, label_table, label_table_names, load_anatomy
from femoreg_torch.errors import InputError

FOOT = """
bones:
  talus_left: {mirror: talus_right, colour: [255, 0, 0], names: [left talus]}
  talus_right: {mirror: talus_left, colour: [0, 255, 0], names: []}
  navicular: {mirror: navicular, colour: [0, 0, 255], names: []}
groups: {tali: [talus_left, talus_right]}
landmarks:
  dome-l: {bone: talus_left, mirror: dome-r, spread_mm: 1.0}
  dome-r: {bone: talus_right, mirror: dome-l, spread_mm: 1.0}
outline: {compare: [talus_left], hidden_by: [navicular]}
"""


def test_the_hip_stands_in_the_order_that_the_network_was_trained_on() -> None:
    assert HIP.bone_names == ("hip_left", "hip_right", "vertebrae", "sacrum", "femur_left", "femur_right")
    stems = ("FH", "GSN", "IOF", "MOF", "SPS", "IPS", "ASIS")
    assert HIP.landmark_names == tuple(f"{stem}-{side}" for stem in stems for side in "lr")
    assert HIP.classes(["pelvis"]) == (1, 2, 4)
    assert HIP.classes(["femur_right", "vertebrae"]) == (6, 3)
    assert HIP.landmarks_of("femur_left") == ("FH-l",)


def test_a_mirror_exchanges_sides_and_twice_it_changes_nothing() -> None:
    assert HIP.mirrored_classes == (0, 2, 1, 3, 4, 6, 5)
    for mirrored in (HIP.mirrored_classes, HIP.mirrored_landmarks):
        assert [mirrored[n] for n in mirrored] == list(range(len(mirrored)))
    names = HIP.landmark_names
    assert all(
        names[n][:-1] == name[:-1] and names[n] != name for n, name in zip(HIP.mirrored_landmarks, names, strict=True)
    )


def test_an_anatomy_of_ones_own_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "foot.yaml").write_text(FOOT, encoding="utf-8")
    foot = load_anatomy(tmp_path / "foot.yaml")
    assert foot.name == "foot"
    assert foot.classes(["tali"]) == (1, 2)
    assert foot.mirrored_classes == (0, 2, 1, 3)
    assert foot.landmark_spread_mm == (1.0, 1.0)
    assert foot.bone("navicular").colour == (0, 0, 255)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mirror: talus_right, colour: [255", "mirror: tibia, colour: [255", "there is no bone 'tibia'"),
        ("colour: [255, 0, 0]", "colour: [255, 0]", "bones.talus_left.colour: three numbers"),
        ("bone: talus_left, mirror: dome-r", "bone: foot, mirror: dome-r", "there is no bone 'foot'"),
        ("mirror: dome-r", "mirror: dome-x", "there is no landmark 'dome-x'"),
        ("spread_mm: 1.0}\n  dome-r", "spread_mm: wide}\n  dome-r", "spread_mm"),
        ("groups:", "group:", "unknown key 'group'"),
    ],
)
def test_what_does_not_fit_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in FOOT
    (tmp_path / "foot.yaml").write_text(FOOT.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=message) as raised:
        load_anatomy(tmp_path / "foot.yaml")
    assert "\n" not in str(raised.value)


def test_every_shipped_table_names_bones_of_the_hip() -> None:
    assert set(label_table_names()) >= {
        "femoreg",
        "totalsegmentator_v1",
        "totalsegmentator_v2",
        "autoseg",
        "pelvic_ref",
    }
    for name in label_table_names():
        assert set(label_table(name)) <= set(HIP.bone_names), name
    assert label_table("femoreg") == {bone: (n,) for n, bone in enumerate(HIP.bone_names, 1)}


def test_bad_tables(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there are: .*totalsegmentator_v2"):
        label_table("totalsegmentator")
    for text, message in (
        ("bones: {hip_left: 1}", "`anatomy` and `bones`"),
        ("anatomy: hip\nbones: {hip_left: -1}", "above 0"),
        ("anatomy: hip\nbones: [1]", r"mine\.yaml, bones: bones with their ids were expected, .* found \[1\]"),
    ):
        (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=message):
            label_table(tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    ("text", "bone"),
    [
        ("Left Femur", "femur_left"),
        ("femur_right", "femur_right"),
        ("hip-left", "hip_left"),
        ("SACRUM", "sacrum"),
        ("Femur (Right)", "femur_right"),
        ("rt. femur", "femur_right"),
        ("Bone, hip; left", "hip_left"),
        ("Vertebrae L5", "vertebrae"),
        ("Hüftbein links", "hip_left"),
        ("rechtes Becken", "hip_right"),
        ("Hueftbein_re", "hip_right"),
        ("Oberschenkelknochen li.", "femur_left"),
        ("Kreuzbein", "sacrum"),
        ("Os coxae sinistrum", "hip_left"),
        ("Femur dexter", "femur_right"),
        ("os iliaque gauche", "hip_left"),
        ("fémur droit", "femur_right"),
        ("fe\N{COMBINING ACUTE ACCENT}mur D", "femur_right"),  # as macOS writes é in names of files
        ("hueso coxal izquierdo", "hip_left"),
        ("FÉMUR der.", "femur_right"),
        ("artère iliaque gauche", None),
        ("Oberschenkel links", None),  # the whole thigh, as likely
        ("l5 femur", None),
        ("femur", None),
        ("liver", None),
    ],
)
def test_bones_by_what_others_call_them(text: str, bone: str | None) -> None:
    assert bone_of_name(HIP, text) == bone

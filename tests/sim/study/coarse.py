"""A patient on voxels of 2 mm under a C-arm of 96 × 96 pixels: procedures on it are simulated in seconds."""

import shutil
from dataclasses import asdict
from pathlib import Path

import yaml

from femoreg_torch.files import plain
from femoreg_torch.geometry import load_carm
from sim.commands import phantom
from sim.study.cases import Stores
from sim.study.procedures import Procedure

SIMULATION = "coarse.yaml"
PROCEDURE = Procedure(number=1, patient="somebody", side="right", seed=2)


def stores_in(root: Path) -> Stores:
    """The folders of a study."""
    return Stores(root / "cases", root / "patients", root / "data")


def coarse_stores(root: Path) -> Stores:
    """The patient where both scans of a subject would stand, with a device of the procedure's seed."""
    stores = stores_in(root)
    folder = stores.patients / PROCEDURE.patient
    phantom(folder / "1.0", seed=PROCEDURE.seed, side=PROCEDURE.hip, spacing_mm=2.0)
    shutil.copytree(folder / "1.0", folder / "0.5")
    return stores


def coarse_simulation(root: Path) -> Path:
    """Settings of a simulation with 16 × 16 pixels of the C-arm in one."""
    carm = load_carm("cios_fusion")
    settings = asdict(carm.camera.downsampled(16)) | {"isocentre_mm": carm.isocentre_mm}
    (root / "carm.yaml").write_text(yaml.safe_dump(plain(settings)), encoding="utf-8")
    content = {"extends": "paper", "carm": str(root / "carm.yaml"), "acquisition": {"step_mm": 1.0}}
    (root / SIMULATION).write_text(yaml.safe_dump(content), encoding="utf-8")
    return root / SIMULATION

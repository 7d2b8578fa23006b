"""The commands `femoreg train` and `femoreg measure`."""

import threading
from pathlib import Path
from typing import Literal


def train(
    settings: str,
    *,
    out: Path,
    cases: list[Path] | None = None,
    cache: Path | None = None,
    override: list[str] | None = None,
    start: Path | None = None,
    resume: bool = False,
    device: Literal["cpu", "cuda", "auto"] = "cpu",
    devices: int = 1,
    nodes: int = 1,
) -> None:
    """Train the landmark and segmentation network and export its weights.

    Views are rendered once into the cache; a run that was stopped goes on with `--resume`. OUT holds the logs
    (CSV and TensorBoard), checkpoints, curves.png, card.md, which says what it was trained on and how it went, and
    hip14.safetensors, the moving average of the weights at their best validation loss.

    Args:
        settings: preset in configs/training (hip14, usual_views, quick, grupp2020), or a YAML file, which may extend
            one.
        out: folder of this run.
        cases: '[FOLDER, …]', patients to learn from beside the procedural ones: case folders, whose case.yaml names CT,
            label map with its table of ids, and landmarks (all 14), or folders with ct.nii.gz, labels.nii.gz (ids of
            the table `femoreg`) and landmarks.json. No two may have one name.
        cache: folder of rendered views, to share between runs; by default OUT/cache.
        override: settings as group.key=value, for instance '[optimisation.epochs=3, cohort.views=10]'.
        start: weights (safetensors) to begin with instead of random ones.
        resume: continue from the last checkpoint in OUT.
        device: where to train: cpu, cuda, or auto, GPUs where there are any.
        devices: how many GPUs, or processes on the CPU, per node; a step then takes a batch on each.
        nodes: how many machines; start the command on each, as Lightning's documentation says for your cluster.
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import tell_device

    place = tell_device(Console(), device)
    threading.excepthook = _told_once
    from training.run import Machine, train_network  # takes seconds
    from training.settings import read_settings

    machine = Machine(place.type, devices, nodes)
    train_network(
        read_settings(settings, override or []), cases or [], out, cache or out / "cache", start, resume, machine
    )


def _told_once(failed: threading.ExceptHookArgs) -> None:
    """TensorBoard writes in a thread, and raises what fails there once more where the next value is logged."""
    if not issubclass(failed.exc_type, OSError):
        threading.__excepthook__(failed)


def measure(
    images: list[Path],
    *,
    out: Path,
    weights: Path | None = None,
    register: list[Path] | None = None,
    altered: bool = False,
) -> None:
    """Measure the landmark network and its start poses on labelled images.

    Writes into OUT: accuracy.json and accuracy.md, with intervals by bootstrap over patients, and reliability.png, the
    share of right landmarks over their confidence.

    Args:
        images: files of labelled images (safetensors), one per patient, that `femoreg labelled-images` made; or HDF5
            files of the public DeepFluoro data set, in either layout.
        out: folder of the results.
        weights: network weights (safetensors); by default the shipped ones.
        register: '[FOLDER, …]', for each file, in the same order, the folder that it was made from; every image with a
            start pose is then registered by the first stages of the preset `fast` (seconds per image).
        altered: also count the start poses in the same images turned by 180°, with inverted grey values, and cropped
            to one hip (takes four times as long).
    """
    from rich.console import Console

    from femoreg_torch.commands.telling import in_place_of
    from femoreg_torch.detect import load_network
    from femoreg_torch.errors import InputError
    from femoreg_torch.files import check_new_folder, new_folder
    from training.accuracy_page import write_accuracy
    from training.labelled import images_of_file
    from training.measure import Reading, read_images
    from training.robustness import ALTERATIONS, outcomes
    from training.single_view import single_view_registration

    if register and len(register) != len(images):
        raise InputError(f"--register: {len(register)} folders for {len(images)} files of images; one each is needed.")
    check_new_folder(out)
    before = in_place_of(out)
    network = load_network(weights)
    readings: list[Reading] = []
    for number, path in enumerate(images):
        registration = single_view_registration(register[number], "fast") if register else None
        readings += read_images(network, images_of_file(path), register=registration)
    counted = {"as they are": outcomes(readings)} if altered else {}
    for name, alter in (ALTERATIONS if altered else {}).items():
        changed = (alter(image) for path in images for image in images_of_file(path))
        counted[name] = outcomes(read_images(network, changed))
    with new_folder(out) as built:
        page = write_accuracy(built, readings, counted)
    Console().print(page, highlight=False)
    Console().print(f"Measured, and written to {out}{before}", markup=False, highlight=False, soft_wrap=True)


def train_segmentation(
    settings: str,
    *,
    shapes: list[Path],
    out: Path,
    cache: Path | None = None,
    resume: bool = False,
) -> None:
    """Train the network that labels bones in a CT, on random CTs around bone shapes, and export its weights.

    OUT holds progress.csv (loss, and Dice on the shapes that are held out), checkpoint.pt and bones6.safetensors,
    written every so many steps: a run that was killed goes on with `--resume`.

    Args:
        settings: preset in configs/segmentation (bones6), or a YAML file, which may extend one.
        shapes: label maps (NIfTI, of Pelvic-Ref or with the ids of the table `autoseg`) and surfaces (.npz).
        out: folder of this run.
        cache: folder of the shapes' distance fields, to share between runs; by default OUT/shapes.
        resume: continue from the checkpoint in OUT.
    """
    from rich.console import Console

    from training.segmentation.learn import read_segmentation_settings
    from training.segmentation.learn import train_segmentation as train

    console = Console(soft_wrap=True)
    path = train(
        read_segmentation_settings(settings),
        shapes,
        out,
        cache or out / "shapes",
        resume,
        lambda text: console.print(text, highlight=False, markup=False),
    )
    console.print(f"Weights written to {path}", markup=False)

"""`femoreg benchmark deepfluoro FILE`: public real data, measured by the protocol of its authors."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from training.measure import Reading

# Grupp et al., IJCARS 15 (2020) 759, abstract: 366 images of six cadavers, a network trained on the five others.
PUBLISHED = {
    "landmark error, mean": "5.0 mm",
    "Dice, left hip bone": "0.86",
    "Dice, right hip bone": "0.87",
    "Dice, left femur": "0.90",
    "Dice, right femur": "0.84",
    "pelvis within 1°, of all images": "86 %",
    "seconds per image": "7",
}


def benchmark(
    dataset: Literal["deepfluoro"], file: Path, *, out: Path, weights: Path | None = None, detection_only: bool = False
) -> None:
    """Measure detection, start and single-view registration on public data, beside the figures of its authors.

    `deepfluoro`: real fluoroscopy of six cadavers (Grupp et al. 2020, CC BY-NC 4.0, doi 10.7281/T1/IFSXNV). FILE is
    ipcai_2020_full_res_data.h5, or one of the preprocessed ipcai_2020_ds_*x.h5, which hold no CT, so that only
    detection is measured. Theirs is a network trained on the other cadavers, the one shipped here has seen simulated
    images alone. An image counts as registered if the rotation of its pelvis is less than 1° from theirs; images whose
    start is refused, or that show fewer than six landmarks, count as not registered.

    Writes into OUT: accuracy.md and accuracy.json, as `femoreg measure`, and beside.md.

    Args:
        dataset: name of the data set.
        file: HDF5 file as it was downloaded, unpacked.
        out: folder of the results.
        weights: network weights (safetensors); by default the shipped ones.
        detection_only: leave registration out (seconds per image).
    """
    import time

    from rich.console import Console
    from torch import Tensor

    from femoreg_torch.detect import load_network
    from femoreg_torch.files import check_new_folder, new_folder, write_text
    from femoreg_torch.neighbours.deepfluoro import is_full_resolution
    from training.accuracy_page import write_accuracy
    from training.labelled import LabelledImage, cadavers, deepfluoro_images
    from training.measure import Reading, Registration, read_images
    from training.single_view import registration_of

    check_new_folder(out)
    network, console = load_network(weights), Console()
    readings: list[Reading] = []
    seconds: list[float] = []

    def timed(register: Registration) -> Registration:
        def run(image: LabelledImage, start: Tensor) -> Tensor:
            began = time.perf_counter()
            found = register(image, start)
            seconds.append(time.perf_counter() - began)
            return found

        return run

    if not detection_only and is_full_resolution(file):
        for cadaver in cadavers(file):
            register = timed(registration_of(cadaver.ct, cadaver.bones, cadaver.landmarks, "fast"))
            readings += read_images(network, cadaver.images, register=register)
            console.print(f"{cadaver.name}: {len(readings)} images so far", highlight=False)
    else:
        readings = read_images(network, deepfluoro_images(file))
    with new_folder(out) as built:
        write_accuracy(built, readings, {})
        page = beside(readings, seconds)
        write_text(built / "beside.md", page)
    console.print(page, highlight=False)


def beside(readings: "list[Reading]", seconds: list[float]) -> str:
    """Published figures and ours as a table in Markdown; a dash where nothing was measured."""
    import numpy as np

    from training.accuracy import REGISTERED_DEG, summarise

    found = {name: measure.value for name, measure in summarise(readings).measures.items()}
    turned = [reading.registered_error[0] for reading in readings if reading.registered_error is not None]
    ours = {
        "landmark error, mean": f"{found['mean_mm']:.1f} mm",
        "Dice, left hip bone": f"{found['dice_hip_left']:.2f}",
        "Dice, right hip bone": f"{found['dice_hip_right']:.2f}",
        "Dice, left femur": f"{found['dice_femur_left']:.2f}",
        "Dice, right femur": f"{found['dice_femur_right']:.2f}",
        "pelvis within 1°, of all images": (
            f"{100 * float(np.mean(np.array(turned) < REGISTERED_DEG)):.0f} %" if turned else "–"
        ),
        "seconds per image": f"{np.mean(seconds):.1f}" if seconds else "–",
    }
    rows = [f"| {name} | {published} | {ours[name]} |" for name, published in PUBLISHED.items()]
    head = [f"| {len(readings)} images | Grupp et al. 2020 | this network |", "| --- | --- | --- |"]
    return "\n".join([*head, *rows]) + "\n"

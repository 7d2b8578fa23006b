"""`femoreg beads CASE` and `femoreg beads-table TRIALS`: poses from metal beads, and registrations against them."""

from pathlib import Path


def beads(case: Path, *, beads: Path, out: Path, run: Path | None = None) -> None:
    """Measure where objects are by metal beads in or on them, the ground truth of a cadaver study.

    FILE names the objects with beads and where the beads are: in a file of points, or, for a bone, to be found in the
    CT. Their shadows are found in the images, or given, and which is which is found out. All images are then fitted at
    once. Writes into OUT a case like CASE without the beads (filled from around, in images and CT), whose truth.json
    the beads tell, to be registered and evaluated as any other; and truth_uncertainty.json (standard deviations in mm
    and degrees, covariance), beads.csv (every shadow with its residual), beads.png. See docs/beads.md.

    Args:
        case: Case folder with case.yaml.
        beads: YAML file of the beads, for instance `objects: {femur: {points: ct, count: 7, diameter_mm: 1}, device:
            {points: device_beads.mrk.json, diameter_mm: 1.5}}`, with, if wanted, `annotations: pixels.csv` (columns
            image, bead, column_px, row_px), `image_noise_px: 0.5`, `views: first`. Points are 3D Slicer markups,
            .fcsv or JSON, mm in the object's space.
        out: Folder to write the case without beads to.
        run: Folder of a registration of CASE, whose poses help to tell which shadow is which bead, and nothing else.
    """
    from rich.console import Console
    from rich.markup import escape

    from femoreg_torch.beads import measure, read_beads, uncertainty_content, write_measured
    from femoreg_torch.case import RESULT_NAME, case_folder, read_case, read_result
    from femoreg_torch.evaluation.fit import check_fits
    from femoreg_torch.files import check_new_folder

    console = Console()
    case = case_folder(case)
    check_new_folder(out, case)
    procedure = read_case(case)
    rough = None
    if run is not None:
        result = read_result(run)
        check_fits(procedure, result)
        rough = result.poses
    with console.status("reading the beads") as status:
        given = read_beads(beads, procedure)
        found = measure(procedure, given, rough, status.update)
        status.update("writing")
        write_measured(out, procedure, found)
    content = uncertainty_content(procedure, found)
    for note in found.notes:
        console.print(f"[yellow]Left out:[/] {escape(note)}")
    used, total = int(found.bundle.used.sum()), len(found.bundle.sights)
    origin = "estimated" if found.bundle.estimated else "given"
    console.print(
        f"{used} of {total} shadows used, {found.bundle.rms_px:.2f} px rms; noise of a shadow {origin}: "
        f"{found.bundle.deviation_px:.2f} px."
    )
    deviations = content["deviations"]
    assert isinstance(deviations, dict)  # rows by name
    for name, row in deviations.items():
        along = ", ".join(f"{axis} {mm:.2f}" for axis, mm in zip(("IS", "LR", "AP"), row["mm_xyz"], strict=True))
        console.print(f"{name}: known to {row['mm']:.2f} mm ({along}) and {row['deg']:.2f}°.")
    if deviations:
        console.print("These hold for a C-arm that is as its file says: a wrong source distance is not in them.")
    console.print(f"The case without beads, and its truth: {escape(str(out))}")
    for earlier in sorted(out.glob(f"*/{RESULT_NAME}")):
        console.print(f"[yellow]{escape(str(earlier.parent))} is of the case that was here before:[/] register again.")


def beads_table(trials: Path, *, run: str = "run") -> None:
    """Tell the errors of registrations against beads, as the paper's Table III and beside it.

    Every trial is a folder that `femoreg beads` wrote, with the result of its registration inside:
    `femoreg register TRIALS/I --out TRIALS/I/run`. Below each error stands what the beads themselves leave open of it.
    A star marks a registration that does not trust itself. The rows are written to TRIALS/trials.parquet, which
    `femoreg tables TRIALS` turns into files for a paper.

    Args:
        trials: Folder of the trials' folders.
        run: Name of the folder in each trial that holds its result.
    """
    from rich.console import Console

    from femoreg_torch.beads import read_trials
    from femoreg_torch.statistics.formats import for_terminal
    from femoreg_torch.statistics.rows import TRIALS_NAME, write_rows
    from femoreg_torch.statistics.trials import rows_of_trials, trial_table

    rows = rows_of_trials(read_trials(trials, run), trials.resolve().name)
    write_rows(rows, trials / TRIALS_NAME)
    console = Console()
    console.print(for_terminal(trial_table(rows), console.width))
    console.print(f"Rows: {trials / TRIALS_NAME}", markup=False, highlight=False, soft_wrap=True)

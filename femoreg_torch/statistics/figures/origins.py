"""What C-arm views, femur and device explain of the relative error."""

import pandas as pd

from femoreg_torch.statistics.figures.style import COLOURS, SINGLE_MM, Plot, new_figure
from femoreg_torch.statistics.origins import SOURCES, relative_origins
from femoreg_torch.statistics.quantities import RELATIVE

_HATCHES = ("", "///", "...")  # so that the bars stay apart in print without colour


def origins(rows: pd.DataFrame) -> Plot | None:
    """A bar for every response, divided among the groups; None where there are too few runs for a regression."""
    found = relative_origins(rows)
    if not found:
        return None
    figure = new_figure(SINGLE_MM, 26 + 9 * len(found))
    axes = figure.subplots()
    for line, explanation in enumerate(found):
        start = 0.0
        for origin, colour, hatch in zip(explanation.origins, COLOURS[1:], _HATCHES, strict=False):
            width = 100 * max(0.0, origin.share)
            axes.barh(line, width, 0.65, start, color=colour, hatch=hatch, edgecolor="white", linewidth=0.5,
                      label=origin.group if line == 0 else None)  # fmt: skip
            if width > 8:
                axes.text(start + width / 2, line, f"{width:.0f} %", ha="center", va="center", fontsize=6.5,
                          bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8})  # fmt: skip
            start += width
        axes.barh(
            line, max(0.0, 100 - start), 0.65, start, color="#e6e6e6", label="not explained" if line == 0 else None
        )
    axes.set_yticks(range(len(found)), [explanation.response for explanation in found])
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel(f"share of the variance of {RELATIVE.name}, %")
    figure.legend(loc="outside upper center", ncols=2)
    caption = (
        f"R² of a linear regression of the error {RELATIVE.name} on the errors of {', '.join(SOURCES)}, divided by the "
        f"mean over all orders of entry; n = {found[0].count} runs. Length: by lengths and angles; along an axis: by "
        "signed parts."
    )
    return Plot("origins", "Where the relative error comes from", caption, figure)

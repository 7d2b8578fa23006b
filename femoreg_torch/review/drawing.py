"""What the page of a review draws over its images: edges of the objects where they are placed, path and guide."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.evaluation.overlay import Renderer, draw, plan_lines
from femoreg_torch.evaluation.report.pictures import PANEL_PX, edge_uri, jpeg_uri
from femoreg_torch.geometry import Poses, project_points
from femoreg_torch.registration import Scene
from femoreg_torch.registration.scene import Kind, reference_point_in_view
from femoreg_torch.review.placing import Placed

_WIDTH_PX, _STEP_MM = 384, 2.0  # of the renderings: as fine as a hand moves, and drawn within tenths of a second


class Edges:
    """The edges of the objects of a scene in its views as pictures, the last ones kept: most objects stand still."""

    def __init__(self, scene: Scene) -> None:
        factor = max(1, scene.carm.camera.shape[1] // _WIDTH_PX)
        self._renderer = Renderer(scene, scene.carm.camera.downsampled(factor), _STEP_MM)
        self._last: dict[tuple[str, int], tuple[Tensor, str]] = {}

    def __call__(self, poses: Poses, name: str, view: int) -> str:
        """The data address of the edges of one object in one view (from 0)."""
        drawn = self._renderer(poses, name, view)
        last = self._last.get((name, view))
        if last is None or last[0] is not drawn:
            last = self._last[name, view] = (drawn, edge_uri(drawn, self._renderer.colours[name]))
        return last[1]


def pictures(scene: Scene, poses: Poses) -> dict[tuple[Kind, int], str]:
    """Every image there is, by kind and view (from 0), as a data address; windowed by the objects at `poses`."""
    return {place: jpeg_uri(picture) for place, picture in draw(scene, poses, PANEL_PX).images.items()}


def drawing(case: Case, scene: Scene, placed: Placed, edges: Edges) -> dict[str, Any]:
    """All that is drawn over the images, for JSON; places are pixels (column, row) of the whole images.

    `views` holds, for each view, edges of its objects by name as pictures and where their reference points are seen, or
    None where the C-arm's pose is not known; `lines` the planned path and the guide by kind of image.
    """
    return {
        "landmarks": placed.landmarks,
        "views": [_view(case, scene, placed, edges, view) for view in range(scene.views)],
    }


def _view(case: Case, scene: Scene, placed: Placed, edges: Edges, view: int) -> Mapping[str, Any] | None:
    if view not in placed.views:
        return None
    poses, camera = placed.poses, scene.camera(placed.poses, view)
    seen = [name for name in poses.camera1_from if scene.there(scene.objects[name].shown_in, (view,))]
    points = {name: reference_point_in_view(scene, poses, name, view) for name in seen}
    return {
        "edges": {name: edges(poses, name, view) for name in seen},
        "centres": {name: project_points(camera, point[None])[0].tolist() for name, point in points.items()},
        "lines": {
            kind: [{"name": line.name, "pixels": line.pixels} for line in lines]
            for kind in scene.images
            if (lines := list(plan_lines(case, poses, view, camera, kind, scene)))
        },
    }

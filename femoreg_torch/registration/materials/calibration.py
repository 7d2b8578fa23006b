"""The step that estimates from the images what nobody tells: what a device is made of, and scattered light."""

import time
from dataclasses import dataclass, replace

from femoreg_torch.case.trace import StageRecord
from femoreg_torch.fluoro import natural
from femoreg_torch.geometry import Poses, pose_difference
from femoreg_torch.registration.materials.device_fit import fit_device
from femoreg_torch.registration.scene import Kind, Scene

_MOST_DEG, _MOST_MM = 8.0, 12.0  # that the device may move; more means that the images do not show it as it is


@dataclass(frozen=True)
class Calibration:
    """A step that estimates what a device attenuates, together with its pose and the scatter in its shadow."""

    name: str

    def left_out(self, scene: Scene, poses: Poses) -> str | None:
        """Why it has nothing to do, see `Step`."""
        shown = devices(scene, poses)
        if not shown:
            if several := _several(scene, poses):
                return f"the {several} images show several devices at once, so that none of them can be estimated"
            return "no device is shown by one kind of images and missing in the first kind"
        kinds = [scene.first_kind, *{kind: None for _, kind in shown}]
        if not all(natural(scene.image(kind, view)) for kind, view in scene.there(kinds, range(scene.views))):
            return (
                "the images hold logarithms of unknown base, or grey values, which tell neither materials nor what "
                "came with a device"
            )
        return None

    def calibrate(self, scene: Scene, poses: Poses) -> tuple[Scene, StageRecord, tuple[str, ...]]:
        """The scene with the device as the images show it, and a record with the poses, that of the device improved.

        And in words, devices that were not estimated.
        """
        began = time.perf_counter()
        moving, cost, evaluations = [], 0.0, 0
        told: list[str] = []
        left: list[str] = []
        for name, kind in devices(scene, poses):
            fit = fit_device(scene, poses, name, kind)
            if fit is None:
                left.append(f"{name} not estimated, as no view shows enough of it")
                continue
            thing = scene.objects[name]
            deg, mm = pose_difference(poses.camera1_from[name], fit.camera1_from, thing.reference_point)
            if deg > _MOST_DEG or mm > _MOST_MM:
                left.append(f"{name} not estimated, as it would have moved by {deg:.0f}° and {mm:.0f} mm")
                continue
            unsure = tuple(difference.to(scene.device) for difference in fit.unsure)
            found = replace(
                thing,
                volume=fit.volume.to(scene.device),
                hardening=fit.hardening,
                unsure=unsure,
                materials_known=fit.as_told,  # one material may be named for a device of several
            )
            objects = scene.objects | {name: found}
            scene = replace(scene, objects=objects, scatter=scene.scatter or fit.scatter)
            poses = poses.with_object(name, fit.camera1_from)
            moving.append(name)
            told.append(f"{name}: {', '.join(f'{a:.2f}' for a in fit.attenuations)}/mm, hardening {fit.hardening:.2f}")
            if fit.scatter is not None:
                told.append(f"scattered light {fit.scatter:.2f} of the primary")
            cost, evaluations = fit.misfit, evaluations + fit.evaluations
        seconds = time.perf_counter() - began
        record = StageRecord(
            self.name,
            None,
            cost,
            evaluations,
            seconds,
            "attenuation of the " + "; ".join(told + left),
            poses,
            moving=tuple(moving),
        )
        return scene, record, tuple(f"attenuation of the {each}: it is drawn as the case tells it" for each in left)


def devices(scene: Scene, poses: Poses) -> list[tuple[str, Kind]]:
    """Objects that are all that one kind of images has more than the first, with that kind, the first of several."""
    found: dict[str, Kind] = {}
    for kind, new in _new(scene, poses):
        if len(new) == 1:
            found.setdefault(new[0], kind)
    return list(found.items())


def _several(scene: Scene, poses: Poses) -> Kind | None:
    """A kind of images that has more than one object more than the first; None if there is none."""
    return next((kind for kind, new in _new(scene, poses) if len(new) > 1), None)


def _new(scene: Scene, poses: Poses) -> list[tuple[Kind, list[str]]]:
    """The kinds of images that there are beside the first, with the objects that each shows and the first does not."""
    return [
        (kind, [n for n in scene.shown(poses.camera1_from, kind) if scene.first_kind not in scene.objects[n].shown_in])
        for kind in list(scene.images)[1:]
        if scene.there([kind], range(scene.views))
    ]

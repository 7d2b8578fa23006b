"""Packages that the core does not need, and the extra that brings each."""

_EXTRA_OF = {  # by import name; the extras themselves stand in pyproject.toml
    "h5py": "sim",
    "manifold3d": "sim",
    "kornia": "train",
    "lightning": "train",
    "tensorboard": "train",
    "dask": "study",
    "distributed": "study",
    "joblib": "study",
    "pandas": "study",
    "psutil": "study",
    "pyamg": "plan",
    "meshio": "plan",
    "imageio_ffmpeg": "video",
    "cascadio": "step",
    "starlette": "review",
    "uvicorn": "review",
    "pyarrow": "plan",  # in `study` too, and in `train` matplotlib; their commands miss others of their extras first
    "matplotlib": "plan",
}


def extra_of(package: str) -> str | None:
    """The extra that brings a package, by its import name; None if none does."""
    return _EXTRA_OF.get(package)


def missing_extra(error: ModuleNotFoundError) -> str | None:
    """One line that says which extra to install for the module that is missing, or None if none has it."""
    package = (error.name or "").partition(".")[0]
    extra = extra_of(package)
    if extra is None:
        return None
    return f"this needs the package {package}, which is not installed: pip install 'femoreg-torch[{extra}]'."

"""Opening HDF5 and Zarr files: their arrays, and the packages that some of their codecs need."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tactflow.engine.errors import SourceError
from tactflow.sources.base import damaged, require
from tactflow.system.extras import missing

ZARR_SUFFIXES = (".zarr", ".zarr.zip")
PACKAGES = {"zfpy": "zfpy", "pcodec": "pcodec", "msgpack2": "msgpack"}
"""Codec of numcodecs -> package that it needs; those of imagecodecs begin with its name."""

Opened = tuple[dict[str, Any], Callable[[], object]]
"""The arrays of a file by name, and the function that closes it."""


def open_arrays(path: Path) -> Opened:
    """Open an HDF5 file, or a Zarr folder or .zip file.

    Raises SourceError if it is damaged, or a package is missing.
    """
    is_zarr = path.name.lower().endswith(ZARR_SUFFIXES)
    if is_zarr:
        require(path, "Zarr files", "zarr", "zarr")
    else:
        require(path, "HDF5 files", "hdf5", "h5py")
    try:
        return _open_zarr(path) if is_zarr else _open_hdf5(path)
    except SourceError:
        raise
    except Exception as error:
        raise damaged(str(path), error) from error


def _open_hdf5(path: Path) -> Opened:
    import h5py  # type: ignore[import-untyped]

    file = h5py.File(path, "r")
    arrays: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        # Skip those with pixels in other files, which may be any file of this machine.
        if isinstance(item, h5py.Dataset) and not item.external and not item.is_virtual:
            arrays[f"/{name}"] = item

    file.visititems(visit)
    return arrays, file.close


def _open_zarr(path: Path) -> Opened:
    import zarr

    store = zarr.storage.ZipStore(path, mode="r") if path.is_file() else None
    close = store.close if store is not None else lambda: None
    try:
        try:
            arrays = _zarr_arrays(store or str(path))
        except ValueError as error:
            # Zarr and numcodecs each have a class of this name.
            if type(error).__name__ != "UnknownCodecError":
                raise
            _add_codecs(path, error)
            arrays = _zarr_arrays(store or str(path))
    except BaseException:
        close()
        raise
    return arrays, close


def _zarr_arrays(store: Any) -> dict[str, Any]:
    import zarr

    root = zarr.open(store, mode="r")
    members = [("", root)] if isinstance(root, zarr.Array) else root.members(max_depth=None)
    arrays = {f"/{name}": item for name, item in members if isinstance(item, zarr.Array)}
    return {name: array for name, array in arrays.items() if not _is_pickled(array)}


def _is_pickled(array: Any) -> bool:
    """Whether reading a Zarr array may execute code in it: only new versions of numcodecs refuse to."""
    codecs = (*(array.filters or ()), *(array.compressors or ()))
    return any(getattr(codec, "codec_id", None) == "pickle" for codec in codecs)


def _add_codecs(path: Path, error: Exception) -> None:
    """Register the codecs of imagecodecs; raises SourceError if they do not include the unknown one."""
    found = re.search(r"'([\w.]+)'", str(error))
    codec = found[1] if found else str(error)
    if not codec.startswith("imagecodecs_"):
        package = PACKAGES.get(codec)
        remedy = f"needs {package}: pip install {package}" if package else "is in no installed package"
        raise SourceError(f"{path}: the codec {codec} {remedy}") from error
    require(path, f"arrays compressed by {codec}", "codecs", "imagecodecs")
    from imagecodecs.numcodecs import register_codecs

    register_codecs(verbose=False)


def load_filters(array: Any) -> None:
    """Load hdf5plugin, if it is installed, for an HDF5 array with filters that HDF5 itself does not have."""
    if _missing_filters(array) and missing("filters", "codecs", ["hdf5plugin"]) is None:
        import hdf5plugin  # noqa: F401 - registers its filters


def explained(name: str, array: Any, error: Exception) -> SourceError:
    """The error for an array that cannot be read: it is damaged, or needs a package."""
    if isinstance(error, SourceError):
        return error
    filters = " and ".join(_missing_filters(array))
    if not filters:
        return damaged(name, error)
    problem = missing(f"arrays compressed by {filters}", "codecs", ["hdf5plugin"])
    return SourceError(f"{name}: {problem or f'hdf5plugin does not have {filters}'}")


def _missing_filters(array: Any) -> list[str]:
    """The filters of an HDF5 array that are not available, as `blosc (filter 32001)`; none for Zarr."""
    if not hasattr(array, "id"):
        return []
    from h5py import h5z

    chain = array.id.get_create_plist()
    filters = [chain.get_filter(index) for index in range(chain.get_nfilters())]
    return [
        f"{name.decode(errors='replace').partition(';')[0] or 'a filter'} (filter {number})"
        for number, _, _, name in filters
        if not h5z.filter_avail(number)
    ]

"""Resolves `use:` to built-in stages and sinks, plug-ins, and classes in modules or loose files."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import os
import pkgutil
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Literal, get_args

from tactflow.config.models import RESERVED
from tactflow.engine.conformance import component, kind_of
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Component
from tactflow.system.files import read_limited
from tactflow.system.plugins import plugins
from tactflow.system.spelling import closest, did_you_mean

Section = Literal["stages", "sinks"]


def resolve(use: str, section: Section, *folders: Path) -> Component:
    """Find and validate the class named by `use`.

    use : a built-in name, the name of an installed plug-in, `package.module:Class`, or `./file.py:Class`
        (`./file.py` alone where the file holds one class).
    section : "stages" or "sinks", its part of the pipeline file.
    folders : to search for a loose file, in this order.

    Raises
    ------
    ConfigError : the name is unknown or ambiguous, or the class violates the contract.
    """
    file, separator, name = use.rpartition(":")
    if not separator and _is_file(use):
        file, name = use, ""
    if _is_file(file):
        resolved = _component(_load_file(folders, file), name, section, use, file)
    elif separator:
        resolved = _component(_load_module(file), name, section, use, f"module {file}")
    else:
        resolved = _named(use, section)
    if (resolved.kind == "sink") != (section == "sinks"):
        right = "sinks" if resolved.kind == "sink" else "stages"
        raise ConfigError(f"{use} is a {resolved.kind}; it belongs under {right}:")
    return resolved


def catalogue(sections: Sequence[Section] = get_args(Section)) -> tuple[list[Component], list[str]]:
    """All built-in and installed stages and sinks, stages first, by name; and a message for each that cannot
    be used."""
    components: list[Component] = []
    problems: list[str] = []
    for section in sections:
        for name in names(section):
            try:
                components.append(_named(name, section))
            except ConfigError as error:
                problems.append(str(error))
    return components, problems


def names(section: Section) -> list[str]:
    """Names of the built-ins and plug-ins of a section, without importing them."""
    return sorted({*_builtins(section), *(entry.name for entry in plugins(f"tactflow.{section}"))})


def _is_file(text: str) -> bool:
    return text.endswith(".py") or text.startswith(("./", "../", "/"))


def _builtins(section: Section) -> list[str]:
    package = importlib.import_module(f"tactflow.{section}")
    return [module.name for module in pkgutil.iter_modules(package.__path__) if module.name[0] != "_"]


def _named(name: str, section: Section) -> Component:
    # Built-ins first, because searching for plug-ins takes some milliseconds.
    if name in _builtins(section):
        module = _load_module(f"tactflow.{section}.{name}")
        return _component(module, "", section, name, "built-in")
    entries = [entry for entry in plugins(f"tactflow.{section}") if entry.name == name]
    origins = [f"plug-in {entry.dist.name} {entry.dist.version}" for entry in entries if entry.dist]
    if len(entries) > 1:
        raise ConfigError(
            f"{name} is claimed by {' and by '.join(origins)}; name the class instead "
            f"(use: {' or '.join(entry.value for entry in entries)}) or uninstall one of them"
        )
    if entries:
        module = _load_module(entries[0].module, origins[0])
        return _component(module, entries[0].attr, section, name, origins[0])
    opposite: Section = "sinks" if section == "stages" else "stages"
    if name in names(opposite):
        raise ConfigError(f"{name} is under {section}: but belongs under {opposite}:")
    raise ConfigError(
        f"there is no {section[:-1]} called {name or repr(name)}{did_you_mean(name, names(section))}"
        + ("" if closest(name, names(section)) else "; a class of your own is named as ./file.py:Class")
    )


def _component(module: ModuleType, name: str, section: Section, use: str, origin: str) -> Component:
    return component(_find_class(module, name, section), use, origin, RESERVED)


def _load_module(name: str, owner: str = "") -> ModuleType:
    if not re.fullmatch(r"\w+(\.\w+)*", name):
        raise ConfigError(f"{name!r} is not the name of a module; required package.module:Class")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and (name == error.name or name.startswith(error.name + ".")):
            raise ConfigError(
                f"{owner and owner + ': '}there is no module {error.name}; "
                "is it installed in this environment? A loose file is named as ./file.py:Class"
            ) from None
        raise ConfigError(_failure(name, error)) from None
    except (Exception, SystemExit) as error:
        raise ConfigError(_failure(name, error)) from None


def _load_file(folders: Sequence[Path], file: str) -> ModuleType:
    """Run a Python file as a module, once for each version of the file."""
    # Both folders may be the same.
    paths = list(dict.fromkeys(Path(os.path.abspath(folder / file)) for folder in folders))
    path = next(filter(os.path.exists, paths), paths[0])
    try:
        source = read_limited(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"cannot read {file}: {reason} ({' or '.join(map(str, paths))})") from None
    digest = hashlib.sha256(str(path).encode() + b"\0" + source).hexdigest()[:16]
    name = f"tactflow_file_{path.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = str(path)
    # Dataclasses and annotations look up their module by name while the file runs.
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise ConfigError(_failure(file, error, str(path))) from None
    return module


def _failure(module: str, error: BaseException, file: str | None = None) -> str:
    """Why a module cannot be loaded, with the location in the code."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: cannot load {module}: {error.msg}"
    text = f"cannot load {module}: {type(error).__name__}: {error}"
    place = code_place(error.__traceback__, file)
    return f"{place}: {text}" if place else text


def code_place(trace: TracebackType | None, file: str | None = None) -> str | None:
    """`file:line` of the last frame of a traceback (in `file` if given) that is not the import system's."""
    own = ("<frozen", __file__, str(importlib.__file__))
    frames = [frame for frame in traceback.extract_tb(trace) if not frame.filename.startswith(own)]
    frames = [frame for frame in frames if frame.filename == file] or frames
    return f"{frames[-1].filename}:{frames[-1].lineno}" if frames else None


def _find_class(module: ModuleType, name: str, section: Section) -> type:
    """The class called `name`, or the one public stage or sink class that the module defines."""
    # Modules built into Python have no file.
    where = getattr(module, "__file__", None) or module.__name__
    public = {
        key: value
        for key, value in vars(module).items()
        if inspect.isclass(value) and value.__module__ == module.__name__ and key[0] != "_"
    }
    usable = {key: value for key, value in public.items() if kind_of(value)}
    if name:
        cls = getattr(module, name, None)
        if inspect.isclass(cls):
            return cls
        raise ConfigError(f"{where} has no class {name}{did_you_mean(name, usable or public, 'it has ')}")
    if len(set(usable.values())) == 1:
        return next(iter(usable.values()))
    base = "Sink" if section == "sinks" else "Stage or Source"
    if usable:
        raise ConfigError(f"{where} has several classes ({', '.join(usable)}); name one, as in FILE:Class")
    raise ConfigError(f"{where} has no public class that inherits from {base} of tactflow")

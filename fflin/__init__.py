"""Linear models of free-floating robots from URDF, for analysis, control and simulation."""

from importlib import import_module
from pathlib import Path
from typing import Any

from fflin.base.version import __version__

# The stub beside this file is the only list of the public names, grouped by task, with their
# modules. A name is imported when it is first used, so that a command without dynamics does not
# load Pinocchio.
_titles: dict[str, list[str]] = {}
_modules: dict[str, str] = {}
for _line in Path(__file__).with_suffix(".pyi").read_text("utf-8").splitlines():
    if _line.startswith("# "):
        _names = _titles[_line[2:]] = []
    elif _line.startswith("from "):
        _, _module, _, _name, *_ = _line.split()
        _modules[_name] = _module
        _names.append(_name)

for _title, _names in _titles.items():
    _rows = (", ".join(_names[at : at + 4]) for at in range(0, len(_names), 4))
    __doc__ = "\n    ".join((f"{__doc__}\n\n{_title}", *_rows))

__all__ = sorted(_modules)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _modules:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(_modules[name]), name)
    if type(value) is type(__getattr__):
        _untyped(value)
    globals()[name] = value
    return value


def _untyped(function: Any) -> None:
    """Let help show a signature without types, which its docstring gives in words and shapes."""
    from inspect import Parameter, signature

    shown = signature(function)
    plain = [each.replace(annotation=Parameter.empty) for each in shown.parameters.values()]
    function.__signature__ = shown.replace(parameters=plain, return_annotation=Parameter.empty)


def __dir__() -> list[str]:
    own = (name for name in globals() if name.startswith("__") and name.endswith("__"))
    return sorted({*own, *_modules})

"""Linear models of free-floating robots from URDF, for analysis, control and simulation."""

from importlib import import_module

from fflin.base import __version__

# Public names by task, with their modules: {title: {name: module}}. The stub lists them for type
# checkers too. A name is imported when it is first used (PEP 562), so that a command without
# dynamics does not load Pinocchio.
_PUBLIC: dict[str, dict[str, str]] = {}
with open(f"{__path__[0]}/__init__.pyi", encoding="utf-8") as _stub:
    for _line in _stub:
        if _line.startswith("# "):
            _names = _PUBLIC[_line[2:].strip()] = {}
        elif _line.startswith("from "):
            _, _module, _, _name, *_ = _line.split()
            _names[_name] = _module

_MODULES: dict[str, str] = {}
for _title, _names in _PUBLIC.items():
    _list = list(_names)
    _rows = [", ".join(_list[at : at + 4]) for at in range(0, len(_list), 4)]
    __doc__ = "\n    ".join((f"{__doc__}\n\n{_title}", *_rows))
    _MODULES |= _names

__all__ = sorted(_MODULES)  # noqa: PLE0605


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'fflin' has no attribute '{name}'")
    value = getattr(import_module(_MODULES[name]), name)
    if type(value) is type(__getattr__):
        _untyped(value)
    globals()[name] = value
    return value


def _untyped(function: object) -> None:
    """Remove the types from the signature that help shows; the docstring describes them."""
    from inspect import Parameter, signature

    shown = signature(function)
    plain = [each.replace(annotation=Parameter.empty) for each in shown.parameters.values()]
    function.__signature__ = shown.replace(parameters=plain, return_annotation=Parameter.empty)


def __dir__() -> list[str]:
    own = (name for name in globals() if name.startswith("__") and name.endswith("__"))
    return sorted({*own, *_MODULES})

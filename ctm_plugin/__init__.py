"""Color Transform Module: learn, with the scene, the colour space in which a radiance field is trained.

``import ctm_plugin as ctm`` offers the names of :data:`FRONT`; torch is imported when one of them is used.
"""

from importlib import import_module

__version__ = "0.10.0"
FRONT = {"Auto": "color.auto", "CTM": "color.ctm", "AttachTransform": "callbacks.attach_ctm"}
FRONT |= dict.fromkeys(("fit", "load_run", "losses", "transform"), "front")
"""Public names of the package for other programs, and the module that defines each."""


def __getattr__(name: str) -> object:
    if name not in FRONT:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{FRONT[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *FRONT})

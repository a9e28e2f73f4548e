"""Type checks of functions without shapes by beartype alone.

``--jaxtyping-packages`` puts ``jaxtyping.jaxtyped`` on every function of the package, which binds the arguments of each
call and has beartype look at them twice: half of the time that checks take goes into functions that name no shape.
"""

import inspect
from collections.abc import Callable
from typing import Any, get_args, get_type_hints

import jaxtyping

with_shapes = jaxtyping.jaxtyped


def names_a_shape(hint: Any) -> bool:
    """Whether one of jaxtyping's types is in an annotation."""
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(names_a_shape(each) for each in get_args(hint))


def plain(thing: Any) -> bool:
    """Whether it is a function whose annotations can be read and name no shape.

    None inside another function: beartype would keep that one's variables, a run's whole module among them.
    """
    if "<locals>" in getattr(thing, "__qualname__", ""):
        return False
    try:
        return inspect.isfunction(thing) and not any(map(names_a_shape, get_type_hints(thing).values()))
    except (NameError, TypeError, AttributeError):  # of a class that is not whole yet, or imported for people alone
        return False


def jaxtyped(*, typechecker: Callable) -> Callable:
    """Stand in for jaxtyping's own where its import hook decorates."""
    return lambda thing: typechecker(thing) if plain(thing) else with_shapes(thing, typechecker=typechecker)

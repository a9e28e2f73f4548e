"""Type checks by beartype alone, which looks at each argument and result once, made for what is called.

``--jaxtyping-packages`` puts ``jaxtyping.jaxtyped`` on every function of the package. It binds the arguments of each
call, has beartype look at them twice, and makes the code that looks anew for each function that a call makes inside
another: all that takes longer than what most tests do.
"""

import functools
import inspect
from collections.abc import Callable
from types import CellType, CodeType, FunctionType
from typing import Any, get_args, get_type_hints

import jaxtyping

with_shapes = jaxtyping.jaxtyped
checkers: dict[CodeType, Callable] = {}


def names_a_shape(hint: Any) -> bool:
    """Whether one of jaxtyping's types is in an annotation."""
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(names_a_shape(each) for each in get_args(hint))


def checker(function: FunctionType, typechecker: Callable) -> Callable:
    """A function of a function like this one and of its arguments: its result, with all that is annotated checked."""

    def by_jaxtyping(this: Callable, /, *args: Any, **kwargs: Any) -> Any:
        return with_shapes(this, typechecker=typechecker)(*args, **kwargs)

    try:
        hints = get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):  # of what is imported for people alone
        return by_jaxtyping
    shapes = any(map(names_a_shape, hints.values()))
    if shapes and inspect.isgeneratorfunction(function):
        return by_jaxtyping
    # Without what it has of the function around it, a run's whole module perhaps, which would be kept.
    empty = tuple(CellType() for _ in function.__code__.co_freevars)
    bare = FunctionType(function.__code__, function.__globals__, function.__name__, function.__defaults__, empty)
    bare.__annotations__, bare.__kwdefaults__, bare.__module__ = hints, function.__kwdefaults__, function.__module__
    check = typechecker(bare)
    if check is bare:  # nothing is annotated
        return lambda this, /, *args, **kwargs: this(*args, **kwargs)
    if not shapes:
        return lambda this, /, *args, **kwargs: check(*args, __beartype_func=this, **kwargs)
    context = with_shapes("context")

    def in_context(this: Callable, /, *args: Any, **kwargs: Any) -> Any:
        with context:
            return check(*args, __beartype_func=this, **kwargs)

    return in_context


def checked(function: FunctionType, typechecker: Callable) -> Callable:
    check = None

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal check
        if check is None:
            code = function.__code__
            check = checkers[code] = checkers.get(code) or checker(function, typechecker)
        return check(function, *args, **kwargs)

    return call


def jaxtyped(*, typechecker: Callable) -> Callable:
    """Stand in for jaxtyping's own where its import hook decorates."""
    return lambda thing: (
        checked(thing, typechecker) if inspect.isfunction(thing) else with_shapes(thing, typechecker=typechecker)
    )

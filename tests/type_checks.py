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
checkers: dict[CodeType, tuple[dict[str, Any] | None, Callable]] = {}
"""What checks functions of a code, and the types that it was made for."""


def names_a_shape(hint: Any) -> bool:
    """Whether one of jaxtyping's types is in an annotation."""
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(names_a_shape(each) for each in get_args(hint))


def hints_of(function: FunctionType) -> dict[str, Any] | None:
    """Its annotations as types; None where one cannot be had: of a class that is not whole yet, or for people alone."""
    try:
        return get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):
        return None


def checker(function: FunctionType, hints: dict[str, Any] | None, typechecker: Callable) -> Callable:
    """A function of a function like this one and of its arguments: its result, with all that is annotated checked."""

    def by_jaxtyping(this: Callable, /, *args: Any, **kwargs: Any) -> Any:
        return with_shapes(this, typechecker=typechecker)(*args, **kwargs)

    if hints is None:
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


class Checked:
    """A function whose first call makes what checks it; elsewhere, pickled, it is the function alone.

    What it names is looked up where it is written, not in a test that has put another class in one's place. Functions
    inside others are written in each call of those, and have a checker in common while they name the same.
    """

    def __init__(self, function: FunctionType, typechecker: Callable):
        self.function, self.typechecker = function, typechecker
        self.check: Callable | None = None
        self.hints = None if "<locals>" in function.__qualname__ else hints_of(function)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        if self.check is None:
            hints, code = self.hints or hints_of(self.function), self.function.__code__
            made_for, check = checkers.get(code, (None, None))
            if check is None or made_for != hints:
                check = checker(self.function, hints, self.typechecker)
                checkers[code] = hints, check
            self.check = check
        return self.check(self.function, *args, **kwargs)

    def __reduce__(self) -> tuple:
        return functools.partial, (self.function,)


def checked(function: FunctionType, typechecker: Callable) -> Callable:
    checks = Checked(function, typechecker)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return checks(*args, **kwargs)

    return call


def jaxtyped(*, typechecker: Callable) -> Callable:
    """Stand in for jaxtyping's own where its import hook decorates."""
    return lambda thing: (
        checked(thing, typechecker) if inspect.isfunction(thing) else with_shapes(thing, typechecker=typechecker)
    )

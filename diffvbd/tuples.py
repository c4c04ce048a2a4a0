"""Named tuples with some of their values changed."""

from typing import Any, TypeVar

Tuple = TypeVar("Tuple", bound=tuple)


def replaced(values: Tuple, **changes: Any) -> Tuple:
    """As ``values._replace(**changes)``, which torch.compile of torch 2.11 cannot follow."""
    given: Any = values
    return type(values)(**{**given._asdict(), **changes})

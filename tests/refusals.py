"""What every refusal is: one line that names the place, what was found and what is allowed."""

from collections.abc import Callable

import pytest

from identification import InputError


def refused(call: Callable[..., object], *arguments: object, names: tuple[str, ...] | list[str]) -> str:
    """The line with which a call is refused, which has all of these parts."""
    with pytest.raises(InputError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    assert [part for part in names if part not in message] == [], message
    return message

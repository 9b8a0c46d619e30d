"""Values given by name: what has the same names and shapes is resolved and checked once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from posmas_fmi.errors import FmuError, InputError
from posmas_fmi.fmu.variables import REAL, WHOLE, Ports, Variable, Variables

if TYPE_CHECKING:
    from posmas_fmi.expression import Array

# name and shape of each number, name and None of each text
Key = tuple[tuple[str, tuple[int, ...] | None], ...]
Whole = np.ndarray[tuple[int], np.dtype[np.int64]]


@attrs.frozen(eq=False)
class Form:
    """What values of the same names and shapes have in common.

    Attributes
    ----------
    variables : Variables
        Of the FMU.
    names : tuple of str
        Of the numbers: scalars, elements (``u[1]``) or arrays.
    begin : (n + 1,) tuple of int
        Where the numbers of each begin, one after the other.
    ports : Ports
        All of them, in that order.
    whole : tuple of int
        Which names are of variables that take whole numbers only.
    texts : mapping of str to Variable
        By name.
    inputs : Form or None
        Those that are inputs, if there are any.
    input_at : (k,) array of int
        Where their numbers are among all.
    """

    variables: Variables
    names: tuple[str, ...]
    begin: tuple[int, ...]
    ports: Ports
    whole: tuple[int, ...]
    texts: Mapping[str, Variable]
    inputs: Form | None
    input_at: Whole

    def part(self, number: int) -> slice:
        """Where the numbers of a name are."""
        return slice(self.begin[number], self.begin[number + 1])

    def given(self, flat: Array, texts: Mapping[str, str]) -> Given:
        """Return such values.

        Raises
        ------
        FmuError
            If there are fractions where whole numbers are taken.
        """
        for number in self.whole:
            values = flat[self.part(number)]
            if not (values == np.rint(values)).all():
                name, shown = self.names[number], values if values.size > 1 else values[0]
                raise FmuError(
                    f"expected whole numbers for {name!r} (got {shown})", self.variables.where
                )
        return Given(self, flat, texts)


@attrs.frozen(eq=False)
class Given(Mapping[str, Any]):
    """Values by name, all numbers one after the other.

    Attributes
    ----------
    form : Form
    flat : (n,) array
    texts : mapping of str to str
    """

    form: Form
    flat: Array
    texts: Mapping[str, str]

    def __getitem__(self, name: str) -> Any:
        if name in self.texts:
            return self.texts[name]
        if name not in self.form.names:
            raise KeyError(name)
        return self.flat[self.form.part(self.form.names.index(name))]

    def __iter__(self) -> Iterator[str]:
        yield from self.form.names
        yield from self.texts

    def __len__(self) -> int:
        return len(self.form.names) + len(self.texts)

    @property
    def inputs(self) -> Given | None:
        """Those that are inputs, if there are any."""
        form = self.form.inputs
        if form is None:
            return None
        texts = {name: self.texts[name] for name in form.texts}
        return Given(form, self.flat[self.form.input_at], texts)


class Forms:
    """The forms of values that have been given to the instances of an FMU.

    Parameters
    ----------
    variables : Variables
    version : {1, 2, 3}
        FMI version.
    """

    def __init__(self, variables: Variables, version: int) -> None:
        self._variables, self._version = variables, version
        self._known: dict[Key, Form] = {}

    def given(self, values: Mapping[str, Any]) -> Given:
        """Resolve values by name: scalars, elements or whole arrays, also flattened, and texts.

        Raises
        ------
        FmuError
            If a name is unknown, or a shape or type wrong.
        InputError
            If a value is neither a text nor numbers.
        """
        if isinstance(values, Given) and values.form.variables is self._variables:
            return values
        plain, key = as_arrays(values)
        form = self._form(key)
        return form.given(flattened(plain), {name: plain[name] for name in form.texts})

    def _form(self, key: Key) -> Form:
        if key not in self._known:
            self._known[key] = self._resolved(key)
        return self._known[key]

    def _resolved(self, key: Key, of_inputs: bool = False) -> Form:
        texts: dict[str, Variable] = {}
        names: list[str] = []
        whole, begin = [], [0]
        inputs: list[tuple[str, tuple[int, ...] | None]] = []
        input_at: list[int] = []
        for name, shape in key:
            variable, index = self._variables.resolve(name)
            is_input = variable.causality == "input"
            if is_input:
                inputs.append((name, shape))
            self._check(name, shape, variable, () if index is not None else variable.shape)
            if shape is None:
                texts[name] = variable
                continue
            size = math.prod(shape)
            if variable.type in WHOLE:
                whole.append(len(names))
            if is_input:
                input_at += range(begin[-1], begin[-1] + size)
            names.append(name)
            begin.append(begin[-1] + size)
        return Form(
            self._variables,
            tuple(names),
            tuple(begin),
            self._variables.ports(names, self._version),
            tuple(whole),
            texts,
            self._resolved(tuple(inputs), True) if inputs and not of_inputs else None,
            np.array(input_at, dtype=np.int64),
        )

    def _check(
        self,
        name: str,
        given: tuple[int, ...] | None,
        variable: Variable,
        shape: tuple[int, ...],
    ) -> None:
        where = self._variables.where
        if given is None and (variable.type != "String" or variable.size != 1):
            kind = "numbers" if variable.type in REAL | WHOLE else "no text"
            raise FmuError(f"expected {kind} for {name!r}, which is {variable.type}", where)
        if given is not None and variable.type == "String":
            raise FmuError(f"expected a text for {name!r}", where)
        if given is not None and given not in (shape, (math.prod(shape),)):
            raise FmuError(f"expected {name!r} of shape {shape} (got {given})", where)


def as_arrays(values: Mapping[str, Any]) -> tuple[dict[str, Any], Key]:
    """Return values, as arrays where they are no texts, and what they have in common with others.

    Raises
    ------
    InputError
        If one is neither a text nor numbers.
    """
    plain: dict[str, Any] = {}
    key: list[tuple[str, tuple[int, ...] | None]] = []
    for name, value in values.items():
        if isinstance(value, str):
            plain[name] = value
            key.append((name, None))
            continue
        try:
            plain[name] = array = np.asarray(value, dtype=float)
        except (ValueError, TypeError):
            raise InputError(f"expected numbers for {name!r} (got {value!r})") from None
        key.append((name, array.shape))
    return plain, tuple(key)


def flattened(plain: Mapping[str, Any]) -> Array:
    """Return all numbers of what `as_arrays` has made, one after the other."""
    numbers = [value.reshape(-1) for value in plain.values() if not isinstance(value, str)]
    return np.concatenate(numbers) if numbers else np.empty(0)

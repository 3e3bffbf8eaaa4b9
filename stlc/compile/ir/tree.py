"""Trees of formulas and numbers: their traversal and their rewriting.

The children of a node are its fields declared as formulas or numbers, so that classes added to
`stlc.compile.ir.nodes` or `stlc.compile.ir.typed` are traversed and rewritten without further code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeAlias, TypeVar

if TYPE_CHECKING:
    from stlc.compile.ir import nodes as ir

_Sort: TypeAlias = Literal["formula", "formulas", "number", "numbers", "bindings"]
_SORTS: Mapping[str, _Sort] = {
    "Formula": "formula",
    "tuple[Formula, ...]": "formulas",
    "Num": "number",
    "tuple[Num, ...]": "numbers",
    "tuple[tuple[str, Num], ...]": "bindings",
}
"""Declared type of a field of a node class -> kind of children that it holds."""

F = TypeVar("F", bound="FormulaTree[Any]")


@cache
def _shape(kind: Any) -> tuple[tuple[str, _Sort], ...]:
    """Return (name, sort) of each field of a node class (`kind`) that contains child nodes.

    The sort says whether these children are formulas or numbers, and whether there are one or several.
    """
    declared = ((part.name, str(part.type).replace("ir.", "")) for part in fields(kind))
    return tuple((name, _SORTS[text]) for name, text in declared if text in _SORTS)


@cache
def _formulas_of(kind: Any) -> tuple[tuple[str, bool], ...]:
    """Return (name, several) of each field of a node class (`kind`) that contains formulas.

    `several` is True for a tuple of formulas, False for a single formula.
    """
    return tuple((name, sort == "formulas") for name, sort in _shape(kind) if sort.startswith("formula"))


class Tree:
    """Base of numbers and formulas, which compare by structure.

    The hash of a node, which is that of its whole tree, is computed once.

    Attributes:
        is_number: whether the node is a number.
    """

    __slots__ = ("_hash",)
    _hash: int
    is_number: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__hash__ = Tree.__hash__  # type: ignore[method-assign] # else `dataclass` would make one

    def __hash__(self) -> int:
        try:
            return self._hash
        except AttributeError:
            found = hash(tuple(getattr(self, part.name) for part in fields(self) if part.compare))  # type: ignore[arg-type]
            object.__setattr__(self, "_hash", found)
            return found

    @property
    def is_leaf(self) -> bool:
        """True for a number without parts."""
        kind: Any = type(self)
        return self.is_number and not _shape(kind)

    @property
    def children(self) -> tuple[Any, ...]:
        """Formulas and numbers directly below the node, in field order."""
        found: tuple[Any, ...] = ()
        kind: Any = type(self)
        for name, sort in _shape(kind):
            value = getattr(self, name)
            if sort in ("numbers", "formulas"):
                found = found + value if found else value
            elif sort == "bindings":
                found = (*found, *(num for _, num in value))
            else:
                found = (*found, value)
        return found

    def map_children(
        self,
        *,
        formulas: Callable[[Any], Any] | None = None,
        numbers: Callable[[ir.Num], ir.Num] | None = None,
    ) -> Self:
        """Return the node with its children replaced, or the node itself if none changes.

        Args:
            formulas: function from a child formula to its replacement; None keeps all formulas.
            numbers: function from a child number to its replacement; None keeps all numbers.
        """
        changed: dict[str, Any] = {}
        kind: Any = type(self)
        for name, sort in _shape(kind):
            change: Callable[[Any], Any] | None = formulas if sort.startswith("formula") else numbers
            if change is None:
                continue
            value = getattr(self, name)
            if sort in ("formula", "number"):
                new = change(value)
                same = new is value
            elif sort == "bindings":
                new = tuple((bound, change(num)) for bound, num in value)
                same = all(a is b for (_, a), (_, b) in zip(new, value, strict=True))
            else:
                new = tuple(map(change, value))
                same = all(a is b for a, b in zip(new, value, strict=True))
            if not same:
                changed[name] = new
        return replace(self, **changed) if changed else self  # type: ignore[type-var]

    def subexpressions(self) -> Iterator[ir.Num]:
        """Yield all numbers in the node, itself included, and those in its conditions (`if`, `ind`)."""
        stack: list[Any] = [self]
        while stack:
            part = stack.pop()
            if part.is_number:
                yield part
            stack.extend(reversed(part.children))

    def leaves(self) -> Iterator[ir.NumberLeaf]:
        """Yield the constants, signals and frozen values in the node, including those in conditions."""
        stack: list[Any] = [self]
        while stack:
            part = stack.pop()
            if part.is_leaf:
                yield part
            else:
                stack.extend(reversed(part.children))

    def map_leaves(self, change: Callable[[ir.Num], ir.Num]) -> Self:
        """Return the node with each constant, signal and frozen value replaced by `change(leaf)`."""
        if self.is_leaf:
            return change(self)  # type: ignore[arg-type, return-value] # a number for a number

        def below(child: Any) -> Any:
            return child.map_leaves(change)

        return self.map_children(formulas=below, numbers=below)


class FormulaTree(Tree, Generic[F]):
    """Base of formulas, whose operands are formulas of the class `F`."""

    __slots__ = ()

    @property
    def operands(self) -> tuple[F, ...]:
        """Formulas directly below the formula."""
        found: tuple[F, ...] = ()
        kind: Any = type(self)
        for name, several in _formulas_of(kind):
            value = getattr(self, name)
            found += value if several else (value,)
        return found

    @property
    def own_numbers(self) -> tuple[ir.Num, ...]:
        """Numbers directly below the formula: that of a predicate, or those that a `freeze` binds."""
        return tuple(child for child in self.children if child.is_number)

    def walk(self) -> Iterator[F]:
        """Yield the formula and all its sub-formulas, without the conditions in numbers (`if`, `ind`)."""
        yield self  # type: ignore[misc] # `F` is the base of all formulas of this kind
        for part in self.operands:
            yield from part.walk()

    def numbers(self) -> Iterator[ir.Num]:
        """Yield the numbers in the formula: those of its predicates, and those bound by `freeze`."""
        for node in self.walk():
            yield from node.own_numbers

"""Lists of assignments that name intermediate results of numeric expressions."""

from __future__ import annotations

from stlc.compile.ir import nodes as ir


class Assignments:
    """Growing list of assignments that name intermediate results, so that each is computed once.

    Attributes:
        lets: (name, numeric expression), in order.
    """

    def __init__(self) -> None:
        self.lets: list[tuple[str, ir.Num]] = []

    def name(self, num: ir.Num, pattern: str) -> ir.Num:
        """Append an assignment of `num` to a new name, and return a reference to it.

        `pattern` is the form of the name: `{}` in it is replaced by the index of the assignment. A constant
        or a column is returned unchanged, without an assignment.
        """
        if isinstance(num, ir.Const | ir.Signal):
            return num
        self.lets.append((pattern.format(len(self.lets)), num))
        return ir.Signal(self.lets[-1][0])

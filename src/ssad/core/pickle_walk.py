"""What a pickle would cost, found by following its steps without building anything."""

from __future__ import annotations

import io
from pickletools import genops, markobject, opcodes

MOST_STEPS = 5_000_000  # a tensor of a checkpoint takes about 40

_TAKES = {  # of each step: how many values it takes, whether all down to a mark as well, how many it puts back
    op.name: (
        op.stack_before.index(markobject) if markobject in op.stack_before else len(op.stack_before),
        markobject in op.stack_before,
        len(op.stack_after),
    )
    for op in opcodes
}
_FILLS = frozenset({"APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"})  # and put back what they fill
_KEEPS = frozenset({"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"})
_BRINGS = frozenset({"GET", "BINGET", "LONG_BINGET"})


class RefusedError(Exception):
    """A file asks for what no weights need."""


class Steps:
    """How much work a file may still ask for."""

    def __init__(self) -> None:
        self.left = MOST_STEPS

    def take(self, count: int) -> None:
        """Count some more steps.

        Raises:
            RefusedError: There are too many.
        """
        self.left -= count
        if self.left < 0:
            raise RefusedError(f"its pickle takes more than {MOST_STEPS:,} steps to read, far more than weights do")


def walk(file: io.BytesIO, part: str, steps: Steps) -> None:
    """Follow the pickle that starts here, and leave the file where it was.

    A value counts as one step and those of all that it is made of, so that shared parts count each time: small tuples
    of tuples that are huge when unfolded would be hashed for ages, and tuples that are nested very deeply overflow the
    interpreter's stack. Lists, dicts and objects, which are never hashed by what they hold, count as one.

    The interpreter makes room for all numbers up to the one under which a value is kept. Picklers count from 0, so a
    number is always smaller than that of the bytes before it.

    Args:
        file: Stands at the start of a pickle.
        part: What to call the file in an error.
        steps: Those of this pickle are taken from it.

    Raises:
        RefusedError: It would take too many steps, or too much memory.
        ValueError: It is none.
    """
    start = file.tell()
    stack: list[int] = []  # steps of each value; 0 is a mark
    kept: dict[int, int] = {}
    for op, argument, at in genops(file):
        try:
            if op.name in _KEEPS:
                number = len(kept) if argument is None else int(argument)
                if number > (at or 0) - start:
                    raise RefusedError(
                        f"byte {at} of {part} keeps a value as number {number:,}, which no pickle of this size needs"
                    )
                kept[number] = stack[-1]
                continue
            count, to_mark, puts = _TAKES[op.name]
            taken = 1
            while to_mark and (value := stack.pop()):
                taken += value
            for _ in range(count):
                taken += stack.pop()
        except IndexError:
            raise ValueError(f"byte {at} of {part} takes a value that is not there") from None
        steps.take(taken)
        if op.name == "MARK":
            stack.append(0)
        elif op.name in _BRINGS:
            stack.append(kept.get(int(argument or 0), 1))
        else:
            stack += [1 if op.name in _FILLS else taken] * puts
    file.seek(start)

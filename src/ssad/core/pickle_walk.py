"""Cost estimate of a pickle, by following its opcodes without building anything."""

from __future__ import annotations

import io
from pickletools import genops, markobject, opcodes

MAX_STEPS = 5_000_000  # a tensor of a checkpoint takes about 40

_STACK_EFFECTS = {  # of each opcode: values popped, whether also all down to a mark, values pushed
    op.name: (
        op.stack_before.index(markobject) if markobject in op.stack_before else len(op.stack_before),
        markobject in op.stack_before,
        len(op.stack_after),
    )
    for op in opcodes
}
_FILLING_OPCODES = frozenset(
    {"APPEND", "APPENDS", "SETITEM", "SETITEMS", "ADDITEMS", "BUILD"}
)  # and put back what they fill
_MEMO_WRITES = frozenset({"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"})
_MEMO_READS = frozenset({"GET", "BINGET", "LONG_BINGET"})


class RefusedError(Exception):
    """A file requests something that no weights need."""


class StepBudget:
    """Budget of work that a file may still request."""

    def __init__(self) -> None:
        self.remaining = MAX_STEPS

    def take(self, count: int) -> None:
        """Subtract steps from the budget.

        Raises:
            RefusedError: The budget is exhausted.
        """
        self.remaining -= count
        if self.remaining < 0:
            raise RefusedError(f"its pickle takes more than {MAX_STEPS:,} steps to read, far more than weights do")


def walk(file: io.BytesIO, file_name: str, steps: StepBudget) -> None:
    """Follow the pickle that starts here, and restore the position of the file.

    A value costs one step plus the steps of all its parts, so shared parts count each time: small tuples of
    tuples that are huge when unfolded would take ages to hash, and very deeply nested tuples overflow the
    interpreter's stack. Lists, dicts and objects, which are never hashed by their content, cost one step.

    The interpreter allocates its memo up to the largest index in use. Picklers count from 0, so an index is
    always smaller than the number of bytes before it.

    Args:
        file: Positioned at the start of a pickle.
        file_name: Name of the file in an error.
        steps: Budget from which the steps of this pickle are taken.

    Raises:
        RefusedError: It would take too many steps, or too much memory.
        ValueError: It is no pickle.
    """
    start_position = file.tell()
    stack_costs: list[int] = []  # steps of each value; 0 is a mark
    memo_costs: dict[int, int] = {}
    for opcode, argument, opcode_position in genops(file):
        try:
            if opcode.name in _MEMO_WRITES:
                memo_index = len(memo_costs) if argument is None else int(argument)
                if memo_index > (opcode_position or 0) - start_position:
                    raise RefusedError(
                        f"byte {opcode_position} of {file_name} keeps a value as number "
                        f"{memo_index:,}, which no pickle of this size needs"
                    )
                memo_costs[memo_index] = stack_costs[-1]
                continue
            pop_count, pops_to_mark, push_count = _STACK_EFFECTS[opcode.name]
            cost = 1
            while pops_to_mark and (value_cost := stack_costs.pop()):
                cost += value_cost
            for _ in range(pop_count):
                cost += stack_costs.pop()
        except IndexError:
            raise ValueError(f"byte {opcode_position} of {file_name} takes a value that is not there") from None
        steps.take(cost)
        if opcode.name == "MARK":
            stack_costs.append(0)
        elif opcode.name in _MEMO_READS:
            # A shared value counts again at each use, since hashing unfolds it.
            stack_costs.append(memo_costs.get(int(argument or 0), 1))
        else:
            stack_costs += [1 if opcode.name in _FILLING_OPCODES else cost] * push_count
    file.seek(start_position)

"""Tables for a terminal."""

from __future__ import annotations

from collections.abc import Collection, Sequence

# Columns stand closer together in a table that would otherwise be wider [characters].
_GREATEST_WIDTH = 100


def text_table(rows: Sequence[Sequence[str]], rules: Collection[int] = (1,), left_columns: int = 1) -> str:
    """Returns rows of cells as aligned text.

    Args:
        rows: Rows of equal length, the header first; a row of a single cell is a title, which may be wider than its
            column, of the rows below it.
        rules: Indices of the rows above which a horizontal rule is drawn.
        left_columns: Number of columns that are aligned to the left; the others are aligned to the right.
    """
    widths = [max(map(len, column)) for column in zip(*(row for row in rows if len(row) > 1), strict=True)]
    gaps = len(widths) - 1
    gap = 2 if sum(widths) + 2 * gaps <= _GREATEST_WIDTH else 1
    rule = "-" * (sum(widths) + gap * gaps)
    lines = []
    for index, row in enumerate(rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=len(row) > 1)]
        cells[:left_columns] = [cell.ljust(width) for cell, width in zip(row, widths[:left_columns], strict=False)]
        lines += [rule] * (index in rules) + [(" " * gap).join(cells).rstrip()]
    return "\n".join(lines)

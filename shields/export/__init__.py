"""A filter in C99 with its numbers, for boards, and a Python reading of it (docs/deployment.md, "On a board")."""

from shields.export.board_filter import BoardFilter
from shields.export.board_table import BoardTable
from shields.export.c_files import export_c

__all__ = ["BoardFilter", "BoardTable", "export_c"]

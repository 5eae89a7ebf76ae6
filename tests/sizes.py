"""Size and density of Python code in tokens.

Code lines are without docstrings, comments and blanks; tokens are without brackets, commas, colons
and comments, so that neither packing lines nor spreading them changes the count.
"""

import ast
import io
import tokenize
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
_SCOPES = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


class Size(NamedTuple):
    """Tokens of files.

    Args:
        lines: number of code lines.
        tokens: number of tokens.
        functions: tokens of each function, sorted.
    """

    lines: int
    tokens: int
    functions: list[int]


def _docstring_lines(tree: ast.AST) -> set[int]:
    lines: set[int] = set()
    for node in ast.walk(tree):
        if (
            isinstance(node, _SCOPES)
            and ast.get_docstring(node, clean=False) is not None
        ):
            first = node.body[0]
            lines |= set(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return lines


def tokens_by_line(text: str) -> Counter[int]:
    """{line number: tokens} of a module's code lines."""
    skipped = _docstring_lines(ast.parse(text))
    counts: Counter[int] = Counter()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        bracket = token.type == tokenize.OP and token.string in "()[]{},:"
        if token.type not in _LAYOUT and not bracket and token.start[0] not in skipped:
            counts[token.start[0]] += 1
    return counts


def size_of(files: list[Path]) -> Size:
    """The size of several files together."""
    sizes = [_size_of_text(path.read_text(encoding="utf-8")) for path in files]
    return Size(
        sum(size.lines for size in sizes),
        sum(size.tokens for size in sizes),
        sorted(tokens for size in sizes for tokens in size.functions),
    )


@cache
def _size_of_text(text: str) -> Size:
    counts = tokens_by_line(text)
    functions = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            last = node.end_lineno or node.lineno
            functions.append(sum(counts[n] for n in range(node.lineno, last + 1)))
    return Size(len(counts), counts.total(), functions)

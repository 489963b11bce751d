# SPDX-License-Identifier: Apache-2.0
"""Changes that mistake one side of the car for the other: front for rear, left for right.

Cosmic Ray has no such change, and it is the likeliest mistake in a law that counts wheels. Swapped are, one at a time:

- a name that is read, such as `front_slip`, `vehicle.front` or `fl`, where the other side's name exists in the module;
- a constant index of a wheel or an axle (0 to 3), for the wheel beside it and for the one behind it;
- two elements of a tuple, or two arguments of a call, that name the two sides of the same thing;
- two of the four elements of a tuple in the order of the wheels: of one axle, or of one side.

What is the same by construction is no change: two arguments that a function of the module uses in sums, products,
minima and maxima alone, where their order says nothing.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator, Mapping

#: Part of a name -> the same of the other side.
_ACROSS = {"left": "right", "right": "left", "fl": "fr", "fr": "fl", "rl": "rr", "rr": "rl"}
_ALONG = {"front": "rear", "rear": "front", "fl": "rl", "rl": "fl", "fr": "rr", "rr": "fr"}
_PART = re.compile(r"[A-Za-z]+|[^A-Za-z]+")
_WHEELS = 4
#: Functions whose arguments have no order.
_EITHER_WAY = ("min", "max", "worse_slip")


def _other_names(name: str) -> set[str]:
    """The names of the other side."""
    parts = _PART.findall(name)
    swapped = {"".join(sides.get(part, part) for part in parts) for sides in (_ACROSS, _ALONG)}
    return swapped - {name}


class _Text:
    """A source whose pieces are found by their place in its tree."""

    def __init__(self, source: str) -> None:
        self.data = source.encode()
        self.tree = ast.parse(source)
        self._starts = [0]
        for line in self.data.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line))

    def span(self, node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            self._starts[node.lineno - 1] + node.col_offset,
            self._starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def of(self, node: ast.expr) -> str:
        start, end = self.span(node)
        return self.data[start:end].decode()

    def replaced(self, start: int, end: int, text: str) -> str:
        return (self.data[:start] + text.encode() + self.data[end:]).decode()

    def exchanged(self, one: ast.expr, other: ast.expr) -> str:
        (a, b), (c, d) = self.span(one), self.span(other)
        data = self.data
        return (data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]).decode()


def _known_names(tree: ast.AST) -> set[str]:
    known: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            known.add(node.id)
        elif isinstance(node, ast.Attribute):
            known.add(node.attr)
        elif isinstance(node, ast.arg):
            known.add(node.arg)
    return known


def _pairs(text: _Text, elements: list[ast.expr], wheels: bool) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Elements that stand for the two sides of something."""
    for i, one in enumerate(elements):
        for j, other in enumerate(elements[i + 1 :], i + 1):
            beside = wheels and i ^ j in (1, 2)
            if text.of(one) != text.of(other) and (beside or text.of(other) in _other_names(text.of(one))):
                yield one, other


class _Ordered(ast.NodeTransformer):
    """Puts what has no order into one, under other names if need be."""

    def __init__(self, names: Mapping[str, str]) -> None:
        self._names = names

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return ast.Name(self._names.get(node.id, node.id), node.ctx)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.op, ast.Add | ast.Mult):
            node.left, node.right = sorted((node.left, node.right), key=ast.dump)
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id in _EITHER_WAY:
            node.args.sort(key=ast.dump)
        return node


def _ordered(source: str, names: Mapping[str, str]) -> list[str]:
    return [ast.dump(_Ordered(names).visit(node)) for node in ast.parse(source).body]


def _without_order(tree: ast.Module) -> set[tuple[str, int, int]]:
    """Functions with two parameters that may be exchanged: name, and which two."""
    found = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            body, names = "\n".join(map(ast.unparse, node.body)), [argument.arg for argument in node.args.args]
            for (i, one), (j, other) in itertools.combinations(enumerate(names), 2):
                if other in _other_names(one) and _ordered(body, {}) == _ordered(body, {one: other, other: one}):
                    found.add((node.name, i, j))
    return found


def _is_shape(node: ast.expr) -> bool:
    return isinstance(node, ast.Attribute) and node.attr == "shape"


def swaps_of(source: str) -> list[str]:
    """The source with one swap each, in the order of their places."""
    text = _Text(source)
    known, either_way = _known_names(text.tree), _without_order(text.tree)
    # What is only asked for membership has no order.
    unordered = {
        id(part)
        for node in ast.walk(text.tree)
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn)
        for part in ast.walk(node.comparators[0])
    }
    found: list[str] = []
    for node in ast.walk(text.tree):
        if id(node) in unordered:
            continue
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Load):
            name = node.id if isinstance(node, ast.Name) else node.attr
            end = text.span(node)[1]
            start = end - len(name.encode())
            found += [text.replaced(start, end, other) for other in sorted(_other_names(name) & known)]
        elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant) and not _is_shape(node.value):
            index = node.slice.value
            if type(index) is int and 0 <= index < _WHEELS:
                found += [text.replaced(*text.span(node.slice), str(index ^ bit)) for bit in (1, 2)]
        elif isinstance(node, ast.Tuple):
            found += [text.exchanged(*pair) for pair in _pairs(text, node.elts, len(node.elts) == _WHEELS)]
        elif isinstance(node, ast.Call) and text.of(node.func) not in _EITHER_WAY:
            function, places = text.of(node.func), {id(argument): i for i, argument in enumerate(node.args)}
            found += [
                text.exchanged(one, other)
                for one, other in _pairs(text, node.args, False)
                if (function, places[id(one)], places[id(other)]) not in either_way
            ]
    return found

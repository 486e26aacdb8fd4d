"""Lua with the numbers of an autopilot: every sum, product and literal of a script rounded to 32 bits.

`lupa` computes in 64 bits. Rounding each result of +, -, * and / from there is, for these operations, exactly what
32-bit arithmetic gives (53 bits are more than twice 24, and two); integers wrap at 2^32. The autopilot of the tests
rounds what `math.exp` and the like return.
"""

from __future__ import annotations

import re

import numpy as np

__all__ = ["in_32_bits"]

_TOKEN = re.compile(
    r"""\s+|--\[\[.*?\]\]|--[^\n]*|(?P<number>0x[0-9a-fA-F]+|\d+\.?\d*(?:e[+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"""
    r"""|(?P<string>"(?:[^"\\]|\\.)*")|(?P<sign>\.\.\.|\.\.|==|~=|<=|>=|//|[-+*/%#<>=(){}\[\];:,.])""",
    re.DOTALL,
)
_BINARY = {
    "or": 1,
    "and": 2,
    **dict.fromkeys(("<", ">", "<=", ">=", "~=", "=="), 3),
    "..": 4,
    "+": 5,
    "-": 5,
    "*": 6,
    "/": 6,
    "//": 6,
    "%": 6,
}
_UNARY = 7
_ROUNDED = {"+", "-", "*", "/", "//", "%"}
_HEAD = """
local function R(x)
   if math.type(x) == "float" then
      local big = x * 536870913.0
      local rounded = big - (big - x)
      return rounded == rounded and rounded or x
   end
   return type(x) == "number" and ((x + 0x80000000) & 0xffffffff) - 0x80000000 or x
end
"""


def in_32_bits(script: str) -> str:
    """The same script with 32-bit arithmetic."""
    return _HEAD + _Script(script).block()


class _Script:
    def __init__(self, text: str) -> None:
        self._tokens: list[tuple[str, str]] = []
        at = 0
        while at < len(text):
            match = _TOKEN.match(text, at)
            assert match, text[at : at + 40]
            at = match.end()
            if match.lastgroup:
                self._tokens.append((match.lastgroup, match[match.lastgroup]))
        self._at = 0

    @property
    def _next(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else "<end>"

    def _take(self, *expected: str) -> str:
        word = self._next
        assert not expected or word in expected, (expected, self._tokens[self._at - 5 : self._at + 5])
        self._at += 1
        return word

    def block(self) -> str:
        lines = []
        while self._next not in ("end", "else", "elseif", "<end>"):
            lines.append(self._statement())
        return "\n".join(lines) + "\n"

    def _statement(self) -> str:
        word = self._next
        if word in ("if", "while", "for"):
            return self._branches() if word == "if" else self._loop()
        if word == "local":
            self._take()
            if self._next == "function":
                return "local " + self._function()
            return "local " + self._assignment()
        if word == "function":
            return self._function()
        if word == "return":
            self._take()
            return "return " + ("" if self._next in ("end", "else", "elseif", "<end>") else self._list())
        return self._assignment()

    def _branches(self) -> str:
        text = f"{self._take()} {self._expression()} {self._take('then')}\n{self.block()}"
        while self._next == "elseif":
            text += f"{self._take()} {self._expression()} {self._take('then')}\n{self.block()}"
        if self._next == "else":
            text += f"{self._take()}\n{self.block()}"
        return text + self._take("end")

    def _loop(self) -> str:
        head = self._take("while", "for")
        if head == "while":
            head += f" {self._expression()}"
        else:
            while self._next not in ("=", "in"):
                head += " " + self._take()
            head += f" {self._take()} {self._list()}"
        return f"{head} {self._take('do')}\n{self.block()}{self._take('end')}"

    def _function(self) -> str:
        text = self._take("function")
        while self._next != ")":
            text += " " + self._take()
        return f"{text}{self._take(')')}\n{self.block()}{self._take('end')}"

    def _assignment(self) -> str:
        text = self._list()
        return f"{text} {self._take()} {self._list()}" if self._next == "=" else text

    def _list(self) -> str:
        parts = [self._expression()]
        while self._next == ",":
            self._take()
            parts.append(self._expression())
        return ", ".join(parts)

    def _expression(self, least: int = 1) -> str:
        unary = self._next in ("-", "not", "#")
        left = f"{self._take()} {self._expression(_UNARY)}" if unary else self._simple()
        while _BINARY.get(self._next, 0) >= least:
            sign = self._take()
            right = self._expression(_BINARY[sign] + (sign != ".."))
            left = f"R({left} {sign} {right})" if sign in _ROUNDED else f"({left} {sign} {right})"
        return left

    def _simple(self) -> str:
        kind, word = self._tokens[self._at]
        self._at += 1
        if kind == "number":
            return repr(float(np.float32(word))) if re.search(r"[.e]", word) and "x" not in word else word
        if kind == "string":
            return word
        if word == "{":
            return self._table()
        if word == "function":
            self._at -= 1
            return self._function()
        text = f"({self._expression()}{self._take(')')}" if word == "(" else word
        return text + self._behind()

    def _behind(self) -> str:
        text = ""
        while self._next in (".", ":", "[", "("):
            sign = self._take()
            if sign in ".:":
                text += sign + self._take()
            elif sign == "[":
                text += f"[{self._expression()}{self._take(']')}"
            else:
                text += f"({'' if self._next == ')' else self._list()}{self._take(')')}"
        return text

    def _table(self) -> str:
        parts = []
        while self._next != "}":
            if self._tokens[self._at][0] == "name" and self._tokens[self._at + 1][1] == "=":
                parts.append(f"{self._take()} {self._take('=')} {self._expression()}")
            else:
                parts.append(self._expression())
            if self._next == ",":
                self._take()
        return "{" + ", ".join(parts) + self._take("}")

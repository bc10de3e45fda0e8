"""The commands of a page of the documentation, as they stand there."""

import re
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Command:
    """One line of an unlabelled block; what its comment says first is the machine."""

    text: str
    comment: str

    @property
    def machine(self) -> str:
        """The machine that its comment names."""
        return re.split(r"[,:;]", self.comment)[0].removeprefix("machine ").strip()


class Page:
    """Some sections of a page. Commands are taken one by one; what is left was not tried."""

    def __init__(self, path: str, *headings: str) -> None:
        text = (ROOT / path).read_text(encoding="utf-8")
        parts = re.split(r"^##+ (.*)$", text, flags=re.MULTILINE)
        sections = dict(zip(parts[1::2], parts[2::2], strict=True))
        chosen = headings or tuple(sections)
        blocks = [block for one in chosen for block in _BLOCK.findall(sections[one])]
        self._blocks = blocks
        self.left = [
            _command(line)
            for label, block in blocks
            if not label
            for line in block.splitlines()
            if line
        ]

    @property
    def settings(self) -> dict[str, Any]:
        """The tables of the blocks in TOML."""
        return tomllib.loads("\n".join(block for label, block in self._blocks if label == "toml"))

    @property
    def printed(self) -> list[str]:
        """The lines that programs are said to print."""
        return [
            line for label, block in self._blocks if label == "text" for line in block.splitlines()
        ]

    def take(self, *words: str) -> Command:
        """Take the first command left that has these words in this order, one after another."""
        for command in self.left:
            if tuple(shlex.split(command.text)[: len(words)]) == words:
                self.left.remove(command)
                return command
        raise LookupError(f"{' '.join(words)} is not in the page any more: {self.left}")


def _command(line: str) -> Command:
    text, _, comment = line.partition(" #")
    return Command(text.strip(), comment.strip())

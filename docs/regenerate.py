"""python docs/regenerate.py: run what README and docs command, and write the real output where a block asks for it.

    <!-- output: certified|binds -->      lines with one of these words (a regular expression); all without ": .."
    ```console
    $ python -m design.audit ..
    ```

    <!-- measured: RK4 x 4 -->            the same for a command that is slow or prints times
    ```text
    $ python -m sim.accuracy

A toml block whose first line is `# NAME.toml` is a file for the commands after it; `<!-- picture: FROM TO -->` keeps a
picture that a command has drawn; `<!-- source: FILE FUNCTION -->` before a python block puts that function there.
tests/project/test_docs.py runs the same steps and compares, but for what is measured.
"""

from __future__ import annotations

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_BLOCK = r"(<!-- {}(?:: (.+))? -->\n```{}\n\$ (python (?:-m|examples/).+)\n)((?:.*\n)*?)(?=```)"
SHOWN = re.compile(_BLOCK.format("output", "console"))
MEASURED = re.compile(_BLOCK.format("measured", "text"))
BLOCK = re.compile(r"^```(sh|console|toml|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SOURCE = re.compile(r"(<!-- source: (\S+) (\S+) -->\n)```python\n(?:.*\n)*?```")
PICTURE = re.compile(r"<!-- picture: (\S+) (\S+) -->")


class Step(NamedTuple):
    kind: str  # file | command | python
    text: str
    name: str = ""  # of the file


def steps(text: str) -> Iterator[Step]:
    """What a reader of the page does, in order."""
    for kind, body in BLOCK.findall(text):
        if kind == "toml" and (name := re.match(r"# (\S+\.toml)\n", body)):
            yield Step("file", body, name[1])
        elif kind == "python":
            yield Step("python", body)
        elif kind in ("sh", "console"):
            lines = (line.removeprefix("$ ") for line in body.splitlines())
            yield from (Step("command", line) for line in lines if line.startswith(("python -m", "python examples/")))


def sourced(text: str) -> str:
    """The page with the code of its own functions where it asks for them: <!-- source: FILE FUNCTION -->."""

    def code(match: re.Match[str]) -> str:
        lines = (ROOT / match[2]).read_text(encoding="utf-8").splitlines()
        node = next(n for n in ast.parse("\n".join(lines)).body if getattr(n, "name", "") == match[3])
        return f"{match[1]}```python\n" + "\n".join(lines[node.lineno - 1 : node.end_lineno]) + "\n```"

    return SOURCE.sub(code, text)


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A documented command, in a terminal of 100 columns."""
    here = ("examples/", "tests/")
    words = [str(ROOT / w) if w.startswith(here) else w for w in shlex.split(command, comments=True)]
    shared = {"PATH": os.environ["PATH"], "OPENBLAS_NUM_THREADS": "1"}  # small matrices: threads only wait
    environment = shared | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    return subprocess.run(
        [sys.executable, *words[1:]], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def kept(output: str, pattern: str | None) -> str:
    """The lines of a command's output that a page shows."""
    lines = (line.rstrip() for line in output.splitlines())
    return "".join(f"{line}\n" for line in lines if re.search(pattern or "", line))


def renewed(text: str, printed: dict[str, str]) -> str:
    """The page with what its commands have printed."""
    for blocks in (SHOWN, MEASURED):
        text = blocks.sub(lambda block: block[1] + kept(printed[block[3]], block[2]), text)
    return text


def main() -> int:
    """Run every page that shows output, and rewrite those whose output is another."""
    printed: dict[str, str] = {}
    with TemporaryDirectory() as place:
        folder = Path(place)
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            if not any(kind.search(text) for kind in (SHOWN, MEASURED, PICTURE)):
                continue
            measured = [Step("command", block[3]) for block in MEASURED.finditer(text)]
            for step in [*steps(text), *measured]:
                if step.kind == "file":
                    (folder / step.name).write_text(step.text, encoding="utf-8")
                elif step.kind == "command" and step.text not in printed:
                    print(f"{page.name}: {step.text}", flush=True)
                    done = run(step.text, folder)
                    if done.returncode not in (0, 1):
                        sys.exit(f"{page.name}: {step.text}\n{done.stderr}")
                    printed[step.text] = done.stdout
            for source, target in PICTURE.findall(text):
                shutil.copyfile(folder / source, page.parent / target)
            fresh = sourced(renewed(text, printed))
            if fresh != text:
                page.write_text(fresh, encoding="utf-8")
                print(f"changed: {page.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""python tests/tools/regenerate.py: run the commands of README and docs, and write their output where pages ask for it.

`--check` (part of `make validate`) runs only the slow and the measured commands, and compares their output with that on
the pages (`same_line`). The exit code is 1 if they differ or if a command fails.

    <!-- output: certified|binds -->      lines that match this regular expression; <!-- output --> shows all lines
    ```console
    $ python -m design.audit ..
    ```

    <!-- measured: RK4 x 4 -->            matching lines of a command that is slow or prints times
    ```text
    $ python -m sim.accuracy

A toml or python block whose first line is `# NAME.toml` or `# NAME.py` is a file for the commands after it;
`<!-- picture: FROM TO -->` copies a picture that a command has drawn. tests/project/test_docs.py compares the output of
the other commands.
"""

from __future__ import annotations

import argparse
import itertools
import math
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

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_BLOCK = r"(<!-- {}(?:: (.+))? -->\n```{}\n\$ (python (?:-m|examples/).+)\n)((?:(?!.*```).*\n)*)(?=```)"
SHOWN = re.compile(_BLOCK.format("output", "console"))
MEASURED = re.compile(_BLOCK.format("measured", "text"))
BLOCK = re.compile(r"^```(sh|console|toml|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
PICTURE = re.compile(r"<!-- picture: (\S+) (\S+) -->")
#: commands that take most of a minute
SLOW = re.compile(r"--coupling optimal --(grid 10|varying-delay)|ranges|zwidth --rigid --scenario omega-pair-known")


class Step(NamedTuple):
    kind: str  # file | command | python
    text: str
    name: str = ""  # file name of a step of the kind `file`


def steps(text: str) -> Iterator[Step]:
    """Yield the steps that a reader of the page takes, in order."""
    for kind, body in BLOCK.findall(text):
        if name := re.match(r"# (\S+\.(?:toml|py))\n", body):
            yield Step("file", body, name[1])
        if kind == "python":
            yield Step("python", body)
        elif kind in ("sh", "console"):
            lines = (line.removeprefix("$ ") for line in body.splitlines())
            yield from (Step("command", line) for line in lines if line.startswith(("python -m", "python examples/")))


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a documented command, for a width of 100 columns."""
    here = ("examples/", "tests/")
    words = [str(ROOT / w) if w.startswith(here) else w for w in shlex.split(command, comments=True)]
    shared = {"PATH": os.environ["PATH"], "OPENBLAS_NUM_THREADS": "1"}  # more threads would only wait
    environment = shared | {"PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    return subprocess.run(
        [sys.executable, *words[1:]], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def kept(output: str, pattern: str | None) -> str:
    """Return the lines of a command's output that a page shows."""
    lines = (line.rstrip() for line in output.splitlines())
    return "".join(f"{line}\n" for line in lines if re.search(pattern or "", line))


def renewed(text: str, printed: dict[str, str]) -> str:
    """Return a page with new output; `printed` maps commands to their output."""

    def shown(block: re.Match[str]) -> str:
        return block[1] + kept(printed[block[3]], block[2]) if block[3] in printed else block[0]

    for blocks in (SHOWN, MEASURED):
        text = blocks.sub(shown, text)
    return text


_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?(?![\w])")
#: figures that depend on the machine: seconds, speeds, costs, and the last column of a table
_TIMES = re.compile(
    r"[\d.]+(?= s\b| x real time| simulated seconds per)|(?<=raw steps )[\d.]+|(?<=clipped )[\d.]+|[^│]*│$"
)
_ROUNDING = 1e-6  # smaller errors may be rounding, which depends on the machine


def same_line(shown: str, line: str, measured: bool = False) -> bool:
    """Return whether words are equal, and numbers differ by at most 2 units in the last place shown or by 0.2 %.

    In measured output, times are ignored, and errors (`1.2e-05`) may differ by a factor of two or be below 1e-6.
    """
    if measured:
        shown, line = _TIMES.sub("", shown), _TIMES.sub("", line)
    shown, line = " ".join(shown.split()), " ".join(line.split())
    if _NUMBER.sub("#", shown) != _NUMBER.sub("#", line):
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(line), strict=True)
    return all(_close(a, b, measured) for a, b in pairs)


def _close(shown: str, number: str, measured: bool) -> bool:
    a, b = float(shown), float(number)
    if measured and "e" in shown:
        return max(abs(a), abs(b)) < _ROUNDING or 0.5 <= a / b <= 2 if b else abs(a) < _ROUNDING
    mantissa, _, exponent = shown.partition("e")
    last_place = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    return math.isclose(a, b, rel_tol=2e-3, abs_tol=2 * last_place)


def check() -> int:
    found, printed = 0, {}
    with TemporaryDirectory() as place:
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            slow = [step.text for step in steps(text) if SLOW.search(step.text) and step.kind == "command"]
            blocks = [(*block, False) for block in SHOWN.findall(text) if SLOW.search(block[2])]
            blocks += [(*block, True) for block in MEASURED.findall(text)]
            for command in [*slow, *(command for _, _, command, *_ in blocks)]:
                if command not in printed:
                    print(f"{page.name}: {command}", flush=True)
                    done = run(command, Path(place))
                    printed[command] = done.stdout
                    if done.returncode not in (0, 1):
                        found += 1
                        print(f"  {done.stderr}")
            for _, pattern, command, shown, measured in blocks:
                fresh = kept(printed[command], pattern).splitlines()
                for was, now in itertools.zip_longest(shown.splitlines(), fresh, fillvalue=""):
                    if not same_line(was, now, measured):
                        found += 1
                        print(f"  the page shows      {was}\n  the command prints  {now}")
    return 1 if found else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--check", action="store_true", help="run and compare the slow and the measured commands, and write nothing"
    )
    parser.add_argument(
        "pages", nargs="*", metavar="PAGE", help="pages to renew, by name or path; their measured output stays"
    )
    args = parser.parse_args()
    if args.check:
        return check()
    names = {page.name for page in PAGES}
    some = {Path(page).name for page in args.pages}
    if unknown := some - names:
        parser.error(f"no page {', '.join(sorted(unknown))}; there are {', '.join(sorted(names))}")
    printed: dict[str, str] = {}
    with TemporaryDirectory() as place:
        folder = Path(place)
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            if (some and page.name not in some) or not any(kind.search(text) for kind in (SHOWN, MEASURED, PICTURE)):
                continue
            measured = [] if some else [Step("command", block[3]) for block in MEASURED.finditer(text)]
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
            fresh = renewed(text, printed)
            if fresh != text:
                page.write_text(fresh, encoding="utf-8")
                print(f"changed: {page.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Print the tests of changed files, or with `sources` the changed files of the packages, for `make check`.

Changed tests come first, then test_layers.py, then the tests of each changed file of a package (`_mirror`), the fewest
first, because `make check` ends after a minute.
"""

import re
import subprocess
import sys
from pathlib import Path

PACKAGES = ("models", "controller", "design", "sim", "hw", "cli")


def changed() -> list[str]:
    """Return the paths that differ from HEAD or are untracked; if there are none, those of the last commit."""
    seen = _git("diff", "--name-only", "HEAD") + _git("ls-files", "--others", "--exclude-standard")
    return seen or _git("diff", "--name-only", "HEAD~1")


def tests_of(paths: list[str]) -> list[str]:
    """Return the test files and folders for these paths, in the order of the module docstring."""
    tests = [path for path in paths if path.startswith("tests/") and "/test_" in path and Path(path).exists()]
    first = [path for path in tests if "benchmarks" not in path] + ["tests/project/test_layers.py"]
    mirrors = [_mirror(path) for path in paths if path.endswith(".py") and path.split("/")[0] in PACKAGES]
    return list(dict.fromkeys(first + [test for mirror in sorted(mirrors, key=len) for test in sorted(mirror)]))


def sources_of(paths: list[str]) -> list[str]:
    """Return the arguments of pyright, at least one file; without a file it would check everything."""
    sources = [
        path for path in paths if path.endswith(".py") and path.split("/")[0] in PACKAGES and Path(path).exists()
    ]
    return sources or ["cli/__init__.py"]


def _mirror(path: str) -> set[str]:
    """Return the tests named like the file or a folder of it, else those that import it, else its package's folder."""
    package, *folders = Path(path).parts[:-1]
    tests, stem = sorted(Path("tests").glob("*/test_*.py")), Path(path).stem
    own = {str(test) for test in tests if test.stem[5:] in (stem, *folders)}
    place = r"\.".join([package, *folders])
    imported = re.compile(
        rf"^from {place}(\.{stem} import| import .*\b{stem}\b)|^import {place}\.{stem}\b", re.MULTILINE
    )
    importers = [] if own else [one for one in tests if imported.search(one.read_text())]
    own = own or {str(one) for one in importers if one.parent.name == package} or set(map(str, importers))
    return own or ({f"tests/{package}"} if Path("tests", package).is_dir() else set())


def _git(*words: str) -> list[str]:
    return subprocess.run(["git", *words], capture_output=True, text=True, check=True).stdout.split()


if __name__ == "__main__":
    print(*(sources_of if "sources" in sys.argv else tests_of)(changed()))

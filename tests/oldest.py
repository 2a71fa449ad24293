"""The oldest versions that pyproject.toml allows, as pip takes them: `make oldest` runs tests with them."""

import re
import tomllib
from pathlib import Path

NEEDED = {"pytest", "hypothesis", "pytest-benchmark", "control", "pyserial"}  # of the packages for development


def floors() -> list[str]:
    """name==floor.* of every dependency, and of what the tests need."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    dev = [one for one in project["optional-dependencies"]["dev"] if re.split(r"[^\w-]", one)[0] in NEEDED]
    kept = [*project["dependencies"], *dev]
    pairs = [re.fullmatch(r"([\w-]+)>=([\d.]+)", one) for one in kept]
    found = [(pair[1], pair[2]) for pair in pairs if pair]
    assert len(found) == len(pairs), "a requirement has another form than name>=version"
    return [f"{name}=={version}.*" for name, version in found]


if __name__ == "__main__":
    print(*floors(), sep="\n")

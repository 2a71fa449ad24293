"""Print the oldest versions that pyproject.toml allows, as requirements for pip; `make oldest` tests with them."""

import re
import tomllib
from pathlib import Path

NEEDED = {"pytest", "hypothesis", "pytest-benchmark", "control", "pyserial"}  # development packages that tests need


def floors() -> list[str]:
    """Return NAME==OLDEST.* for every dependency and for the packages that the tests need."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    dev = [
        requirement
        for requirement in project["optional-dependencies"]["dev"]
        if re.split(r"[^\w-]", requirement)[0] in NEEDED
    ]
    requirements = [*project["dependencies"], *dev]
    pairs = [re.fullmatch(r"([\w-]+)>=([\d.]+)", requirement) for requirement in requirements]
    parsed = [(pair[1], pair[2]) for pair in pairs if pair]
    assert len(parsed) == len(pairs), "a requirement has another form than name>=version"
    return [f"{name}=={version}.*" for name, version in parsed]


if __name__ == "__main__":
    print(*floors(), sep="\n")

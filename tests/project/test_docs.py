"""Commands and snippets of README and docs run, the output that pages show is real, and linked files exist."""

import contextlib
import importlib.util
import io
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from forked import run

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("regenerate", ROOT / "tests/tools/regenerate.py")
regenerate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(regenerate)

PAGES = [*regenerate.PAGES, ROOT / "CHANGELOG.md", ROOT / "NOTATION.md"]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
#: commands that take most of a minute: `make validate` runs them, and `make figures` writes what they print
SLOW = regenerate.SLOW
#: command -> the first page that has it; it runs once, although several pages may have it
COMMANDS = {s.text: page.name for page in reversed(PAGES) for s in regenerate.steps(TEXTS[page]) if s.kind == "command"}
IN_ORDER = list(dict.fromkeys(s.text for page in PAGES for s in regenerate.steps(TEXTS[page]) if s.kind == "command"))
IN_ORDER = [command for command in IN_ORDER if not SLOW.search(command)]
SNIPPETS = {p: [s.text for s in regenerate.steps(TEXTS[p]) if s.kind == "python"] for p in PAGES}
SHOWN = [(page, *match.group(3, 2, 4)) for page in PAGES for match in regenerate.SHOWN.finditer(TEXTS[page])]
QUICK = [block for block in SHOWN if not SLOW.search(block[1])]
MEASURED = [(page, *match.group(3, 2, 4)) for page in PAGES for match in regenerate.MEASURED.finditer(TEXTS[page])]


def of_page(page, *values, name):
    """Return a parameter set; `make test` runs those of the README, and `make suite` those of all pages."""
    return pytest.param(*values, id=name, marks=() if page in ("README.md", ROOT / "README.md") else pytest.mark.slow)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Return one folder for all commands, since some read what others write, with the files that pages give."""
    folder = tmp_path_factory.mktemp("docs")
    for step in (s for page in PAGES for s in regenerate.steps(TEXTS[page]) if s.kind == "file"):
        assert not (folder / step.name).exists(), f"two pages give a file {step.name}"
        (folder / step.name).write_text(step.text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def printed():
    """Return a dict for the standard output of each command."""
    return {}


#: the most humans, generations, cells, points and pictures for commands whose output no page shows
FEW = {"humans": 4, "generations": 2, "grid": 5, "points": 1, "fps": 1}


def shortened(command):
    """Return the command with at most FEW humans, generations and so on, unless a page shows its output."""
    if any(command == block[1] for block in SHOWN):
        return command
    return re.sub(rf"--({'|'.join(FEW)}) (\d+)", lambda m: f"--{m[1]} {min(int(m[2]), FEW[m[1]])}", command)


def in_full(command):
    """Return a parameter set that only `make validate` runs."""
    return pytest.param(command, id=f"in full: {command}", marks=pytest.mark.validate)


@pytest.mark.parametrize(
    "command",
    [of_page(COMMANDS[command], shortened(command), name=command) for command in IN_ORDER]
    + [in_full(command) for command in IN_ORDER if shortened(command) != command],
)
def test_every_command_runs(command, place, printed):
    """The exit code is 0 or 1 (the result holds or does not), and there is no traceback."""
    for file in re.findall(r"--coupling (\S+\.json)", command):
        if not (place / file).exists():  # `make validate` selects a command without those before it
            run(next(each for each in IN_ORDER if each.endswith(f"--out {file}")), place)
    done = run(command, place)
    assert done.returncode in (0, 1), f"{command}: {done.stderr}"
    assert "Traceback" not in done.stderr
    printed[command] = done.stdout


@pytest.mark.parametrize(
    ("page", "command", "pattern", "shown"), [of_page(block[0], *block, name=block[1]) for block in QUICK]
)
def test_output_that_a_page_shows_is_the_commands(page, command, pattern, shown, place, printed):
    """`python tests/tools/regenerate.py` writes the output anew."""
    output = printed.get(command) or run(command, place).stdout
    fresh = regenerate.kept(output, pattern).splitlines()
    assert shown.splitlines()
    assert len(fresh) == len(shown.splitlines()), f"{page.name}: {output}"
    assert [a for a, b in zip(shown.splitlines(), fresh, strict=True) if not regenerate.same_line(a, b)] == []


@pytest.mark.parametrize(("page", "command", "pattern", "shown"), MEASURED, ids=[block[1] for block in MEASURED])
def test_measured_output_is_of_a_command_that_exists(page, command, pattern, shown):
    """Commands with measured output take minutes; `python tests/tools/regenerate.py --check` runs them."""
    module = command.split()[2]
    assert importlib.util.find_spec(module) is not None
    assert shown
    assert shown == regenerate.kept(shown, pattern)


@pytest.mark.slow
@pytest.mark.parametrize("page", [of_page(page, page, name=page.name) for page in PAGES if SNIPPETS[page]])
def test_every_snippet_runs(page, place, monkeypatch):
    """The Python blocks of a page run in order, in one namespace."""
    monkeypatch.chdir(place)
    monkeypatch.syspath_prepend(place)
    namespace = {"__name__": "snippet"}
    with contextlib.redirect_stdout(io.StringIO()):
        for number, snippet in enumerate(SNIPPETS[page], start=1):
            exec(compile(snippet, f"{page.name}, Python block {number}", "exec"), namespace)


def test_pages_get_the_lines_they_request():
    page = "<!-- output: certified -->\n```console\n$ python -m x\nold\n```\nafter\n```console\n$ python -m x\n```\n"
    fresh = regenerate.renewed(page, {"python -m x": "noise\nis certified  \nmore noise\n"})
    assert fresh == page.replace("old", "is certified")


def test_same_lines_differ_by_small_errors_only():
    same_line = regenerate.same_line
    assert same_line("needs 1.370 of 1.37 N s/m", "needs 1.372 of 1.37 N s/m")
    assert not same_line("needs 1.370 of 1.37 N s/m", "needs 1.375 of 1.37 N s/m")
    assert not same_line("0 unstable", "3 unstable")
    assert not same_line("case I", "case II")


def test_measured_lines_compare_without_times():
    row = "│ RK4 x 1 │ 1.8e-06 │ -3.0e-01 │ right │ 9.2586 │ 83.781 │ 128 │"
    for other, same in [
        (row.replace("128", " 61"), True),
        (row.replace("1.8e-06", "1.9e-06"), True),
        (row.replace("-3.0e-01", "-3.0e+00"), False),
        (row.replace("right", "WRONG"), False),
        (row.replace("9.2586", "9.3586"), False),
    ]:
        assert regenerate.same_line(row, other, measured=True) == same
    line = "exact 0.032 s, 799 unstable; 96 x real time, loop / raw steps 1.19 (median of 10), error 3.3e-14"
    assert regenerate.same_line(line, re.sub(r"0\.032|96|1\.19", "7", line).replace("3.3e-14", "8e-15"), measured=True)
    assert not regenerate.same_line(line, line.replace("799", "790"), measured=True)


def test_measured_blocks_are_compared_but_for_times(monkeypatch, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- measured: rows -->\n```text\n$ python -m x\n3 rows in 0.2 s\n```\n")
    monkeypatch.setattr(regenerate, "PAGES", [page])
    for printed, different in (("noise\n3 rows in 9 s\n", 0), ("9 rows in 0.2 s\n", 1), ("", 1)):
        monkeypatch.setattr(regenerate, "run", lambda *words, out=printed: SimpleNamespace(stdout=out, returncode=0))
        assert regenerate.check() == different
    assert "the command prints  9 rows in 0.2 s" in capsys.readouterr().out


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_blocks_end_and_follow_their_comments(page):
    fences = re.findall(r"^.*```.*$", TEXTS[page], re.MULTILINE)
    assert len(fences) % 2 == 0
    assert set(fences[1::2]) <= {"```"}, "a code block has no end"
    assert all(fence.startswith("```") for fence in fences)
    comments = re.findall(r"^<!-- (?:output|measured)\b", TEXTS[page], re.MULTILINE)
    assert len(comments) == sum(block[0] == page for block in SHOWN + MEASURED)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_pictures_and_named_tests_exist(page):
    """A page names a test as file::test, or as ::test of the file that it named before."""
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", TEXTS[page]):
        assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name} names {target}"
    file = None
    for path, name, test in re.findall(r"(tests/[\w/]+\.py)?(\btest_\w+\.py)?::(\w+)", TEXTS[page]):
        files = [ROOT / path] if path else list((ROOT / "tests").rglob(name)) if name else [file]
        assert any(f"def {test}(" in file.read_text() for file in files), f"{page.name} names {test}"
        file = files[0]


def test_make_targets_that_pages_name_exist():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    blocks = re.findall(r"```(?:sh|console)\n(.*?)```", "".join(TEXTS.values()), flags=re.DOTALL)
    named = [line.split()[1] for block in blocks for line in block.splitlines() if line.startswith("make ")]
    named += re.findall(r"`make ([a-z]+)`", "".join(TEXTS.values()))
    assert named
    assert set(named) <= set(targets)

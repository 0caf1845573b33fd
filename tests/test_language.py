"""Language of the project: American English, and the words of the field."""

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# What is checked: paths relative to the repository, folders with all they hold.
COVERED = (
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "cohdc_train",
    "configs",
    "docker",
    "docs",
    "tests",
    "tools",
)
SUFFIXES = (".py", ".md", ".yaml", ".yml", ".toml")
APART = ("tests/test_language.py", "CHANGELOG.md")
HISTORY = "docs/log/"  # describes earlier versions in their own words, like CHANGELOG.md

# Words of the field that a reader need not look up, in place of words of our own.
PRIVATE = {
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\bheirs?\b": "successor",
    r"\bspent\b": "elapsed, used",
    r"\bseldom\b": "rarely",
    r"\banew\b": "again",
    r"\bbesides\b": "as well, also",
    r"\bpictures?\b": "image",
    r"\bevery one\b": "each",
    r"\b(leav(e|es|ing)|left) out\b": "skip, omit",
    r"\b(tak(e|es|en|ing)|took) over\b": "load, transfer",
    r"\bholds? good\b": "is valid",
    r"\bgives? way\b": "yields",
    r"\bat once\b": "immediately, together",
    r"\bwhat stands still\b": "static structure",
    r"\bwhat moves\b": "moving objects",
    r"\bon whole pixels\b": "at integer pixel positions",
}

# American spelling of British stems; the rest of the word stays.
_STEMS = {
    r"colour": "color",
    r"centre": "center",
    r"centring": "centering",
    r"grey": "gray",
    r"metres?\b": "meter",
    r"neighbour": "neighbor",
    r"behaviour": "behavior",
    r"favour": "favor",
    r"honour": "honor",
    r"labour": "labor",
    r"rumour": "rumor",
    r"vapour": "vapor",
    r"harbour": "harbor",
    r"labell(ed|ing)": "label",
    r"travell(ed|ing|er)": "travel",
    r"cancell(ed|ing)": "cancel",
    r"modell(ed|ing)": "model",
    r"signall(ed|ing)": "signal",
    r"artefact": "artifact",
    r"catalogue": "catalog",
    r"judgement": "judgment",
    r"analys(e|ed|ing)\b": "analyze",
    r"defence": "defense",
    r"\blicence": "license",
    r"\bwhilst\b": "while",
    r"\btowards\b": "toward",
}
# Stems of words that end in -ise in American English, too.
_REAL_ISE = frozenset(
    (
        *("adv", "advert", "appra", "ar", "bru", "cerc", "chast", "compr", "comprom", "conc", "cr"),
        *("cru", "dem", "desp", "dev", "disgu", "enterpr", "exc", "exerc", "expert", "franch"),
        *("gu", "improv", "inc", "lia", "m", "merchand", "parad", "po", "pr", "pra", "prec"),
        *("prem", "prom", "r", "ra", "rev", "superv", "surm", "surpr", "telev", "treat"),
    )
)
_ISE = re.compile(r"\b([a-z]*?)is(e|ed|es|er|ers|ing|ation|ations)\b")
# Keys and headers of files that stay as they are (house rule), and names of other projects.
QUOTED = (
    *("quantised_operators", "--pictures", "pictures/", "pictures:", '"pictures"'),
    *('"spent"', '"at_once:AtOnce"'),  # old names that golden_flow.py knows
    "comment metres; x right",  # of map.ply and cloud.ply
)


def british(line: str) -> list[str]:
    """List the British spellings of a line."""
    found = [m[0] for stem in _STEMS for m in re.finditer(rf"[a-z]*{stem}[a-z]*", line.lower())]
    for match in _ISE.finditer(line.lower().replace("_", " ")):
        stem = match[1]
        is_compound = stem.endswith(("w", "no"))  # likewise, RandomGaussianNoise
        if stem not in _REAL_ISE and not is_compound:
            found.append(match[0])
    return found


def private(line: str) -> list[str]:
    """List the private words of a line, with what to write instead."""
    words = line.replace("_", " ")
    return [
        f"{match[0]} ({better})"
        for pattern, better in PRIVATE.items()
        for match in re.finditer(pattern, words, re.IGNORECASE)
    ]


def covered_files() -> Iterator[Path]:
    """List the tracked text files that are checked."""
    command = ["git", "-C", str(ROOT), "ls-files", "--", *COVERED]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in listed.splitlines():
        is_exempt = name in APART or name.startswith(HISTORY)
        if name.endswith(SUFFIXES) and not is_exempt:
            yield ROOT / name


def findings(path: Path) -> list[str]:
    """List the words of a file that are to be replaced, with their line."""
    text = path.read_text(encoding="utf-8")
    for quoted in QUOTED:
        text = text.replace(quoted, "")
    if not british(text) and not private(text):  # much faster than line by line
        return []
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = [*british(line), *private(line)]
        found += [f"{path.relative_to(ROOT)}:{number}: {word}" for word in words]
    return found


def test_covered_files_use_american_english_and_the_words_of_the_field() -> None:
    files = list(covered_files())
    assert len(files) > 50
    assert [word for file in files for word in findings(file)] == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("the colour of a neighbour", ["colour", "neighbour"]),
        ("quantise, Normalisation and recognised", ["quantise", "normalisation", "recognised"]),
        ("two metres to the centre of a grey wall", ["centre", "grey", "metres"]),
        ("otherwise it is a precise, noisy surprise, raised and advised", []),
        ("a pairwise exercise in rising noise, revised and supervised", []),
        ("parameters and meters, a labeled analysis of the colors", []),
        ("def synchronise_frames(): ...", ["synchronise"]),
    ],
)
def test_british_spelling_is_found(line: str, expected: list[str]) -> None:
    assert sorted(british(line)) == sorted(expected)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("three pictures", ["pictures (image)"]),
        ("def mend_file(): ...", ["mend (fix)"]),
        (
            "it takes over and leaves out",
            ["leaves out (skip, omit)", "takes over (load, transfer)"],
        ),
        ("recommend to spend time at one place", []),
    ],
)
def test_private_word_is_found(line: str, expected: list[str]) -> None:
    assert sorted(private(line)) == sorted(expected)

import base64
import json
import re
from functools import cache
from html.parser import HTMLParser

from experiments.report import comparison_report, sweep_table
from shields import Report
from shields.verification.rational_matrix import flag
from tests.experiments.results import ALL_ARMS, run, summary_of

VERIFIED = Report((flag("(E1) Sigma - A Sigma A' >= 0", True), flag("(S) the safe set", True)))
PNG = b"\x89PNG" + bytes(12) + (1360).to_bytes(4) + b"pixels"
ATTACK = "<script>alert('&')</script>"


class Reader(HTMLParser):
    """Reads a page: tables by name, text, and tags that were not closed."""

    VOID = ("meta", "img", "br", "wbr")

    def __init__(self, page):
        super().__init__()
        self.tables, self.open, self.tags, self.text = {}, [], [], []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "div" and "aria-label" in dict(attributes):
            self.rows = self.tables.setdefault(dict(attributes)["aria-label"], [])
        if tag == "tr" and hasattr(self, "rows"):
            self.rows.append([])
        if tag in ("td", "th") and self.rows is not None:
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text.append(data)
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


def comparison(*names, runs=3, figures=None, findings=(), change=None, **settings):
    results = {name: [run(name, i, **(change or {})) for i in range(runs)] for name in names}
    return comparison_report(summary_of(results, **settings), VERIFIED, figures or {}, list(findings))


@cache
def page_of_all_arms():
    return comparison(*ALL_ARMS, runs=2, figures={"a": ("A. B.", PNG)})


def safety(page):
    return {row[0]: row[1:] for row in Reader(page).tables["Violations and interventions of each arm"]}


def test_page_is_well_formed_and_needs_nothing_from_elsewhere():
    reader = Reader(page := page_of_all_arms())
    assert reader.open == []
    assert not re.search(r"https?:|//[a-z]|@import|url\(", page)
    assert {tag for tag, _ in reader.tags} & {"script", "link", "iframe", "object", "base"} == set()
    sources = [attributes["src"] for _, attributes in reader.tags if "src" in attributes]
    assert [base64.b64decode(source.removeprefix("data:image/png;base64,")) for source in sources] == [PNG]


def attacked(value, text, path):
    """A copy of a JSON value with `text` in one place: instead of what is there, or as its key."""
    first, *rest = path
    if rest == ["as a key"]:
        return {text if other == first else other: value[other] for other in value}
    return value | {first: attacked(value[first], text, rest) if rest else text}


TEXTS = {
    ("settings", "env"),
    ("settings", "certificate"),
    ("certificate",),
    ("plant", "fingerprint"),
    ("versions", "python"),
    ("settings", "hyperparams", "n_envs"),
    ("settings", "hyperparams", "n_envs", "as a key"),
    ("references", "zero input", "as a key"),
}


# Each part leaves another place of a page.
BREAKOUTS = " ".join((ATTACK, '"><script>1</script>', "' onerror='1", "</code></td><img src=x>", "</style>"))


def test_a_text_of_a_summary_stays_text():
    summary = summary_of({name: [run(name)] for name in ("unshielded", "shielded")})
    summary["references"] = {"zero input": summary["arms"]["unshielded"] | {"train_steps": 0}}
    summary = json.loads(json.dumps(summary))
    honest = tags_of(comparison_report(summary, VERIFIED, {"a": ("A. B.", PNG)}, []))
    for path in TEXTS:
        page = comparison_report(attacked(summary, BREAKOUTS, path), VERIFIED, {"a": ("A. B.", PNG)}, [])
        assert tags_of(page) <= honest, path
        assert BREAKOUTS in "".join(Reader(page).text), path


def tags_of(page):
    """Tags of a page with the names of their attributes."""
    return {" ".join([tag, *sorted(attributes)]) for tag, attributes in Reader(page).tags}


def test_every_arm_is_in_every_table_and_explained():
    reader = Reader(page_of_all_arms())
    for name in ("Violations and interventions of each arm", "Return of each arm"):
        assert [row[0] for row in reader.tables[name][1:]] == ALL_ARMS
    assert [row[0] for row in reader.tables["Paired differences"][1:]] == ALL_ARMS[1:]
    assert sum(tag == "dt" for tag, _ in reader.tags) == len(ALL_ARMS)


def test_violations_have_their_exact_interval_and_those_of_state_and_estimate_stand_apart():
    assert "0 of 60 %, at most 45.93 %" in safety(comparison("shielded", runs=3))["shielded"][2]  # 1 - 0.025^(1/6)
    page = comparison("unshielded", change={"violations": (3, 0)})
    assert "3 of 650.0 % [11.8, 88.2]" in safety(page)["unshielded"][2]
    summary = summary_of({"shielded": [run("shielded")]})
    summary["arms"]["shielded"] |= {"eval_violation_steps": 1234, "eval_estimate_violation_steps": 5678}
    assert safety(comparison_report(summary, VERIFIED, {}, []))["shielded"][3:5] == ["1,234", "5,678"]


def test_returns_and_differences_have_students_and_the_bootstraps_interval():
    reader = Reader(comparison("unshielded", "shielded", runs=3))
    (shielded,) = [row[1:] for row in reader.tables["Return of each arm"] if row[0] == "shielded"]
    assert [cell.replace("\N{MINUS SIGN}", "-") for cell in shielded[:3]] == ["-3.0", "[-5.5, -0.5]", "[-4.0, -2.0]"]
    assert reader.tables["Paired differences"][1][1:4] == ["+0.0", "[+0.0, +0.0]", "[+0.0, +0.0]"]


def test_every_condition_has_a_table():
    change = {"scenarios": {"gaussian": run("shielded", violations=(3, 0)).episodes}}
    page = Reader(comparison("shielded", "trusting", change=change))
    table = {row[0]: row[1:] for row in page.tables["Evaluation: gaussian"]}
    assert table["trusting"][:2] == ["3 of 650.0 % [11.8, 88.2]", "9"]
    assert "3 of 3" not in table["trusting"][4]
    assert table["shielded"][4] == "6 of 6"


def test_sweep_says_where_the_proof_did_not_hold():
    arms = summary_of({name: [run(name)] for name in ("unshielded", "shielded")})["arms"]
    held, broken = ({"loss": loss, "mean_loss": loss, "delay": 2, "arms": arms} for loss in (0.3, 0.6))
    assert "The proof held in" not in sweep_table([held, broken])
    broken["arms"] = arms | {"shielded": arms["shielded"] | {"guaranteed_episodes": 1, "eval_episodes": 4}}
    text = "The proof held in some evaluation episodes only: shielded at loss 0.6, delay 2 (1 of 4)."
    assert " ".join(sweep_table([held, broken]).split()).endswith(text)

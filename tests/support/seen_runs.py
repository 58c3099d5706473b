"""Runs as they lie on disk, healthy and ill, and what a browser would make of their report."""

import dataclasses
import re
from html.parser import HTMLParser

from metrpo.config import Config, EnsembleConfig, to_json
from metrpo.run.metrics import to_csv

CONFIG = Config("Swimmer", iterations=12)
ONE = dataclasses.replace(CONFIG, system="k-1", ensemble=EnsembleConfig(members=1))
VOID = {"meta", "br", "img"}
LOADING = {"src", "srcset", "poster", "data", "action", "background", "xlink:href", "formaction", "ping", "cite"}


def details(count=12, dimensions=4):
    """diagnostics.csv of the healthy run; after a whole episode, dimension 2 is worse than no change, and model 3 never
    agrees."""
    worse = lambda k, d: 1.7 if (k, d) == ("T", 2) else 0.1 * (d + 1)  # noqa: E731
    return [
        {"iteration": i, "real_steps": 3000 * i}
        | {f"error_{k}_{d}": worse(k, d) for k in ("1", "5", "T") for d in range(dimensions)}
        | {f"improved_{k}": 0.0 if k == 3 else 0.8 for k in range(5)}
        for i in range(1, count + 1)
    ]


def a_run(folder, config=CONFIG, rows=None, diagnostics=None):
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(to_json(config))
    rows = healthy() if rows is None else rows
    if rows:
        (folder / "metrics.csv").write_text(to_csv(rows))
    if diagnostics:
        (folder / "diagnostics.csv").write_text(to_csv(diagnostics))
    return folder


class Page(HTMLParser):
    """What a browser would make of it: elements, what they refer to, and text; wrong nesting is an error."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.references, self.links, self.open, self.text, self.styles = [], [], [], [], "", ""
        self.feed(text)
        self.close()
        assert self.open == [], "every element is closed"

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        for name, value in attributes:
            assert not name.startswith("on"), "no script in an attribute"
            if name in LOADING or (name == "href" and tag != "a"):
                self.references.append(value)
            if name == "href" and tag == "a":
                self.links.append(value)
            if name == "style":
                self.styles += value
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "style":
            self.styles += data
        else:
            self.text += data


def healthy(count=12):
    """A run that climbs from 0 to 100 and settles; its models promise too much at first, as good ones do."""
    rows = []
    for i in range(1, count + 1):
        real = 100 * (1 - 0.6**i) + 2 * (-1) ** i
        imagined = real + 300 * 0.3**i
        rows.append(
            {
                "iteration": i,
                "real_steps": 3000 * i,
                "return_real": real,
                "return_real_std": 10.0,
                "return_imagined": imagined,
                "gap": imagined - real,
                **{f"validation_loss_{k}": (1 + 0.05 * k) * (1 + 2 * 0.7**i) for k in range(5)},
                "train_loss": 0.5,
                "updates": 100 if i % 4 else 40,
                "accepted_updates": 90 if i % 3 else 0,
                "rejected_steps": 1,
                "fraction_improved": 0.7,
                "kl": 0.008,
                "mean_std": 0.6,
                "saturated": 0.2,
                "diverged": 0.0,
                "error_1": 0.05 + 0.3 * 0.7**i,
                "error_5": 0.08 + 0.4 * 0.7**i,
                "error_T": 0.4 + 1.0 * 0.7**i,
                "disagreement_real": 0.03,
                "disagreement_imagined": 0.04 + 0.5 * 0.5**i,
                "outside": 0.1 + 0.5 * 0.5**i,
                "end_share": 0.02,
                "end_recall": 0.9,
                "end_false_alarms": 0.001,
                "end_error": 0.004,
            }
        )
    return rows


def exploiting():
    return [r | {"gap": 3 * abs(r["return_real"])} if r["iteration"] >= 5 else r for r in healthy()]


def numbers_in(text, attribute):
    return [float(v) for v in re.findall(rf'{attribute}="([-\d.]+)"', text)]

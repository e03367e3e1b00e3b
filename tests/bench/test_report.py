from __future__ import annotations

import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
from rich.console import Console

from tactflow.bench.pareto import Point, pareto, points
from tactflow.bench.quantities import QUANTITIES, format_number
from tactflow.bench.report import html
from tactflow.bench.results import Measurement, Result, Target
from tactflow.bench.scatter import scatter
from tactflow.bench.table import print_result, terminal


def measurement(method: str, scene: str, cost: float, **errors: float) -> Measurement:
    return Measurement("tracker", method, scene, 10, copies={"contact": cost}, errors=errors)


@pytest.fixture
def result() -> Result:
    made = Result(quick=True, copy_ms=0.1, touch_ms=0.05, fault_us=0.4)
    made.measurements = [
        measurement("slow & <exact>", "press", 50, displacement_rms=0.01, wrong_percent=0),
        measurement("slow & <exact>", "cable", 60, displacement_rms=0.02, wrong_percent=0),
        measurement("fast", "press", 5, displacement_rms=0.1, wrong_percent=1),
        measurement("fast", "cable", 6, displacement_rms=0.3, wrong_percent=3),
        measurement("bad", "press", 70, displacement_rms=0.5, wrong_percent=9),
        measurement("bad", "cable", 70, displacement_rms=0.5, wrong_percent=9),
        measurement("only on easy scenes", "press", 1, displacement_rms=0.001, wrong_percent=0),
    ]
    made.measurements[0].limits["displacement_rms"] = 0.003
    made.targets = [
        Target("identities", "<= 0.1 %", "0 %", True, "press"),
        Target("speed", "fast", "-", None),
    ]
    return made


def test_a_point_is_the_median_over_scenes_with_the_worst_one_named(result: Result) -> None:
    found = {p.method: p for p in points(result, "tracker", QUANTITIES["displacement_rms"])}
    fast = found["fast"]
    assert (fast.cost, fast.error, fast.low, fast.high, fast.worst) == (5.5, 0.2, 0.1, 0.3, "cable")


def test_the_front_holds_what_nothing_beats_in_both(result: Result) -> None:
    front = pareto(points(result, "tracker", QUANTITIES["displacement_rms"]))
    assert [p.method for p in front] == ["fast", "slow & <exact>"]


def test_a_method_with_nothing_to_show_in_some_scenes_is_not_on_the_front(result: Result) -> None:
    found = {p.method: p for p in points(result, "tracker", QUANTITIES["displacement_rms"])}
    assert found["only on easy scenes"].missing == 1
    assert "fails: nothing to show in 1 of 2 scenes" in html(result)


def test_equal_errors_leave_the_faster_one_on_the_front() -> None:
    a, b = Point("a", 1, 0.5, 0.5, 0.5, 1, "x"), Point("b", 2, 0.5, 0.5, 0.5, 1, "x")
    assert pareto([b, a]) == [a]


def test_a_faster_method_is_no_better_while_another_of_its_errors_is_larger(result: Result) -> None:
    result.measurements = [
        replace(measurement(method, "press", cost, displacement_rms=0.01, center_error=off), group="pipeline")
        for method, cost, off in (("exact", 10, 0.25), ("careless", 5, 20), ("slow", 20, 0.25))
    ]
    answer = html(result).partition("Run time against error")[0]
    said = re.findall(r"</span> <b>(\w+)</b></td><td>(.*?)</td>", answer)
    assert said == [
        ("careless", "the fastest; 80 times the error of the best: contact centre error, mean"),
        ("exact", "the most accurate; 2 times the time of the fastest"),
        ("slow", "no reason to use it here: exact is faster and at least as accurate"),
    ]
    result.measurements = result.measurements[::2]
    assert "use this: the fastest and the most accurate" in html(result)


def verdicts(result: Result, *methods: tuple[str, float, dict[str, float]]) -> dict[str, str]:
    """What the report says of methods, each a name, a cost and errors in two scenes.

    One whose name begins with `partial` has no `center_error` in the second.
    """
    result.measurements = [
        replace(measurement(method, scene, cost, **errors), group="pipeline")
        for method, cost, errors in methods
        for scene in ("press", "cable")
    ]
    for one in result.measurements:
        if one.method.startswith("partial") and one.scene == "cable":
            del one.errors["center_error"]
    answer = html(result).partition("Run time against error")[0]
    return dict(re.findall(r"</span> <b>([\w ]+)</b></td><td>(.*?)</td>", answer))


def test_a_slower_method_with_nothing_to_show_in_some_scenes_says_so(result: Result) -> None:
    said = verdicts(
        result,
        ("fast", 5, {"displacement_rms": 0.2, "center_error": 0.5}),
        ("partial", 10, {"displacement_rms": 0.1, "center_error": 0.5}),
    )
    assert said["partial"] == (
        "a compromise on the Pareto front; nothing to show in some scenes: contact centre error, mean"
    )


def test_nothing_to_show_counts_more_than_any_error_where_the_best_has_none(result: Result) -> None:
    said = verdicts(
        result,
        ("partial", 5, {"displacement_rms": 0.2, "center_error": 0.5}),
        ("exact", 10, {"displacement_rms": 0.0, "center_error": 0.5}),
    )
    assert said["partial"] == "the fastest; nothing to show in some scenes: contact centre error, mean"


def test_errors_and_times_that_are_about_the_same_are_not_called_1_times_as_large(result: Result) -> None:
    said = verdicts(
        result, ("fast", 5, {"displacement_rms": 0.1001}), ("exact", 5.001, {"displacement_rms": 0.1})
    )
    assert said == {
        "fast": "the fastest; about the error of the best: marker displacement error, RMS",
        "exact": "the most accurate; about the time of the fastest",
    }


class _Collector(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_the_report_needs_nothing_from_elsewhere(result: Result) -> None:
    page = html(result)
    collector = _Collector()
    collector.feed(page)
    assert not {tag for tag, _ in collector.tags} & {"script", "link", "img", "iframe", "object", "embed"}
    assert not [attrs for _, attrs in collector.tags if {"src", "href"} & attrs.keys()]
    assert "url(" not in page
    assert "@import" not in page


def test_names_are_escaped(result: Result) -> None:
    page = html(result)
    assert "<exact>" not in page
    assert "slow &amp; &lt;exact&gt;" in page


def test_every_plot_is_well_formed_and_inside_its_frame(result: Result) -> None:
    plots = re.findall(r"<svg.*?</svg>", html(result), flags=re.S)
    assert len(plots) == 2
    for plot in plots:
        root = ElementTree.fromstring(plot)
        width, height = (float(v) for v in root.attrib["viewBox"].split()[2:])
        circles = root.findall(".//circle")
        assert len(circles) == 4
        for circle in circles:
            assert 0 < float(circle.attrib["cx"]) < width
            assert 0 < float(circle.attrib["cy"]) < height


def test_the_limit_is_drawn_where_it_is_known(result: Result) -> None:
    found = points(result, "tracker", QUANTITIES["displacement_rms"])
    assert "Cramér-Rao limit 0.003" in scatter(found, QUANTITIES["displacement_rms"], 0.003, None)
    assert "Cramér-Rao" not in scatter(found, QUANTITIES["displacement_rms"], None, None)


def test_an_error_of_zero_is_drawn_in_its_own_band(result: Result) -> None:
    plot = scatter(
        points(result, "tracker", QUANTITIES["wrong_percent"]), QUANTITIES["wrong_percent"], None, None
    )
    assert ">none</text>" in plot


def test_all_errors_zero_still_makes_a_plot() -> None:
    zero = [Point("a", 1, 0, 0, 0, 1, "x"), Point("b", 2, 0, 0, 0, 1, "x")]
    ElementTree.fromstring(scatter(zero, QUANTITIES["wrong_percent"], None, None))


def test_labels_of_points_at_one_place_do_not_overlap() -> None:
    crowd = [Point(f"method {i}", 10 + i * 0.01, 0.1, 0.1, 0.1, 1, "x") for i in range(5)]
    root = ElementTree.fromstring(scatter(crowd, QUANTITIES["displacement_rms"], None, None))
    names = [t for t in root.iter("text") if (t.text or "").startswith("method ")]
    assert len(names) == 5
    # Eight letters of 12 px text are about 52 px wide and 12 px high.
    left = [
        float(t.attrib["x"]) - {"start": 0, "middle": 26, "end": 52}[t.attrib["text-anchor"]] for t in names
    ]
    base = [float(t.attrib["y"]) for t in names]
    for i in range(5):
        for j in range(i):
            assert abs(base[i] - base[j]) >= 12 or abs(left[i] - left[j]) >= 52


def test_promises_are_shown_beside_results(result: Result) -> None:
    page = html(result)
    assert "not measured" in page
    assert ">met</span>" in page


def test_the_terminal_shows_methods_and_promises(result: Result) -> None:
    out = io.StringIO()
    print_result(result, Console(file=out, width=200))
    text = out.getvalue()
    assert "Marker tracking" in text
    assert "fast" in text
    assert "identities" in text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (0.0123456, "0.0123"), (12.34, "12.3"), (1234.5, "1234"), (1e-6, "1.0e-06"), (10, "10")],
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize("width", [80, 1000])
def test_nothing_in_the_terminal_is_cut(result: Result, width: int) -> None:
    result.measurements += [
        replace(m, group="pipeline", method=f"{m.method} of the whole") for m in result.measurements
    ]
    out = io.StringIO()
    print_result(result, Console(file=out, width=width))
    text = out.getvalue()
    assert "\u2026" not in text
    assert max(map(len, text.splitlines())) <= width
    for word in ("only on easy scenes of the whole", "slow & <exact>", "0.015 (0.02) *", "missed"):
        assert word in text


def test_what_is_no_terminal_has_no_width() -> None:
    assert terminal(io.StringIO()).width > 500

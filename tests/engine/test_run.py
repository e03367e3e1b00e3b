"""The engine's laws, shown on a graph of toy stages."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from tactflow.engine.run import Runner, RunResult
from tactflow.system.signals import INTERRUPTED_EXIT_CODE
from tests.clock import PATIENCE, until

MakeRunner = Callable[..., Runner]

REPEAT = "pulse.repeating"


def rows(runner: Runner, sink: str = "out") -> list[Any]:
    """What a collecting sink got."""
    return list(runner.nodes[sink].instance.rows)


def seen(runner: Runner, node: str) -> list[int]:
    """The frames a node was called for."""
    return list(runner.nodes[node].instance.seen)


def ran(runner: Runner) -> RunResult:
    """Run to the end, which must be a good one."""
    result = runner.run()
    assert result.error is None
    assert result.exit_code == 0
    return result


def threads_of_runs() -> list[str]:
    """The threads of segments that have not ended."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("tactflow-")]


# -- values -----------------------------------------------------------------------------------------------


def test_every_frame_of_a_recording_reaches_a_lossless_sink_in_order(toy_runner: MakeRunner) -> None:
    runner = toy_runner(sinks={"out": {"use": "Collect"}, "far": {"use": "ThreadedCollect"}})
    result = ran(runner)
    assert [row[0] for row in rows(runner)] == list(range(20))
    assert rows(runner, "far") == rows(runner)
    assert result.stats["frames"] == 20
    assert result.stats["dropped"] == 0
    assert result.stats["end"] == "eos"
    gated = [row[3] for row in rows(runner)]
    assert gated == [i**2 + 0.5 if 3 <= i % 10 <= 6 else None for i in range(20)]
    assert [row[4] for row in rows(runner)] == [{} if g is not None else {"gated": "idle"} for g in gated]


@pytest.mark.parametrize("extra", ["far", "lazy", "rated", "small"])
@pytest.mark.parametrize("skipping", [True, False])
def test_an_observer_never_changes_values(toy_runner: MakeRunner, extra: str, skipping: bool) -> None:
    """Every subset of the other sinks, threaded, uninterested, rate-limited or asking for less."""
    sinks: dict[str, Any] = {
        "out": {"use": "Collect"},
        "far": {"use": "ThreadedCollect"},
        "lazy": {"use": "Collect"},
        "rated": {"use": "ThreadedCollect", "max_rate": 7},
        "small": {"use": "OnlyLevel"},
    }
    gates = held("repeating", hold=1, at_least_every=5) | {"gated": {"when": "keep.held"}}
    alone = toy_runner(gates, {"out": sinks["out"]}, skipping=skipping)
    ran(alone)
    others = [name for name in sinks if name not in ("out", extra)]
    for size in range(len(others) + 1):
        for subset in itertools.combinations(others, size):
            chosen = {name: dict(sinks[name]) for name in ("out", extra, *subset)}
            runner = toy_runner(gates, chosen, skipping=skipping)
            ran(runner)
            assert rows(runner) == rows(alone)
            for name in {"far", "lazy", "rated"} & set(chosen):
                assert set(map(str, rows(runner, name))) <= set(map(str, rows(alone)))


def held(signal: str, **params: int) -> dict[str, dict[str, Any]]:
    """A stage that holds a signal of the toy graph."""
    return {"keep": {"use": "Hold", "in": {"signal": f"pulse.{signal}"}, **params}}


SEGMENTS: dict[str, dict[str, dict[str, Any]]] = {
    "three": {"heavy": {"segment": "b"}, "gated": {"segment": "b"}, "join": {"segment": "c"}},
    "each": {name: {"segment": name} for name in ("level", "pulse", "heavy", "gated", "total", "join")},
    "one": {name: {"segment": "capture"} for name in ("level", "pulse", "heavy", "gated", "total", "join")},
    "tight": {
        name: {"segment": name, "queue": {"capacity": 1, "when_full": "block"}}
        for name in ("level", "pulse", "heavy", "gated", "total", "join")
    },
}


@pytest.mark.parametrize("cut", SEGMENTS)
@pytest.mark.parametrize("signal", ["active", "repeating"])
@pytest.mark.parametrize("hold", [{}, {"hold": 2}, {"at_least_every": 3}])
def test_how_a_graph_is_cut_into_segments_changes_no_value(
    toy_runner: MakeRunner, cut: str, hold: dict[str, int], signal: str
) -> None:
    gate = "keep.held" if hold else f"pulse.{signal}"
    stages: dict[str, Any] = {"gated": {"when": gate}, **(held(signal, **hold) if hold else {})}
    default = toy_runner(stages)
    ran(default)
    for name, body in SEGMENTS[cut].items():
        stages[name] = {**stages.get(name, {}), **body}
    if hold and cut == "one":
        stages["keep"]["segment"] = "capture"
    runner = toy_runner(stages)
    ran(runner)
    assert rows(runner) == rows(default)
    assert len(runner.plan.segments) > 2 or cut == "one"


def test_each_stage_in_its_own_segment_is_the_picture_of_the_graph(toy_runner: MakeRunner) -> None:
    runner = toy_runner(SEGMENTS["each"])
    links = {link.name for link in runner.plan.links}
    assert {"capture->level", "level->heavy", "level->total", "heavy->gated"} <= links
    assert "capture->total" not in links, "the level's link brings the frame along"


# -- skipping ---------------------------------------------------------------------------------------------


def test_a_closed_gate_runs_nothing_that_only_its_stage_needs(toy_runner: MakeRunner) -> None:
    runner = toy_runner()
    result = ran(runner)
    open_frames = [i for i in range(20) if 3 <= i % 10 <= 6]
    assert seen(runner, "heavy") == seen(runner, "gated") == open_frames
    assert result.stats["stages"]["gated"]["skips"] == {"idle": 12}
    assert result.stats["stages"]["heavy"]["skips"] == {"no_demand": 12}
    assert result.stats["signals"]["pulse.active"] == {"true": 8, "rises": 2}


def test_a_gate_spares_nothing_in_other_segments(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"gated": {"segment": "late"}})
    ran(runner)
    assert seen(runner, "heavy") == list(range(20))
    assert seen(runner, "gated") == [i for i in range(20) if 3 <= i % 10 <= 6]


def test_behind_a_closed_gate_another_gate_is_not_evaluated(toy_runner: MakeRunner) -> None:
    stages: dict[str, Any] = {
        "behind": {"use": "Gated", "when": "pulse.active"},
        "even": {"use": "Even"},
        "front": {"use": "Heavy", "in": {"level": "behind.gated"}, "when": "even.active"},
        **dict.fromkeys(("gated", "total", "join")),
    }
    runner = toy_runner(stages, {"out": {"use": "OnlyLevel", "in": {"level": "front.heavy"}}})
    ran(runner)
    assert seen(runner, "pulse") == list(range(0, 20, 2))
    assert seen(runner, "heavy") == seen(runner, "behind") == [4, 6, 14, 16]


def test_a_repeating_gate_gives_its_last_value_and_says_why(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"gated": {"when": REPEAT}})
    ran(runner)
    by_frame = {row[0]: row for row in rows(runner)}
    assert by_frame[2][3] is None
    assert by_frame[9][3] == by_frame[6][3] == 36.5
    assert by_frame[9][4] == {"gated": "idle"}
    assert by_frame[6][4] == {}


@pytest.mark.parametrize("below", [{}, {"segment": "b"}], ids=["same segment", "another"])
def test_a_stage_knows_a_signal_of_the_frame_before(toy_runner: MakeRunner, below: dict[str, str]) -> None:
    runner = toy_runner({"level": {"use": "Watcher"}, "pulse": below})
    ran(runner)
    before = [False, *(3 <= seq % 10 <= 6 for seq in range(19))]
    assert runner.nodes["level"].instance.rows == (before if not below else [False, *[True] * 19])


@pytest.mark.parametrize("cut", [{}, SEGMENTS["each"]], ids=["default", "each"])
def test_a_pure_stage_is_not_run_again_on_inputs_it_has_seen(
    toy_runner: MakeRunner, cut: dict[str, Any]
) -> None:
    """The level is repeated while the pulse is low, so what follows from it alone is reused."""
    stages = {**cut, "level": {**cut.get("level", {}), "when": REPEAT}}
    stages["gated"] = {**cut.get("gated", {}), "when": []}
    runner = toy_runner(stages)
    result = ran(runner)
    ran_in = [i for i in range(20) if 3 <= i % 10 <= 6]
    assert seen(runner, "heavy") == seen(runner, "gated") == ran_in
    by_frame = {row[0]: row for row in rows(runner)}
    assert by_frame[8][3] == by_frame[6][3] == 36.5
    assert by_frame[8][4] == {"gated": "idle"}
    assert by_frame[6][4] == {}
    assert result.stats["stages"]["heavy"]["skips"] == {"idle": 3, "unchanged": 9}
    assert len(seen(runner, "total")) == 17, "a stateful stage sees a repeated input again"


@pytest.mark.parametrize("order", [1, -1])
def test_outputs_that_one_gate_makes_absent_are_not_repeated_by_another(
    toy_runner: MakeRunner, order: int
) -> None:
    gates = ["pulse.active", "even.repeating"]
    runner = toy_runner({"even": {"use": "Even"}, "gated": {"when": gates[::order]}})
    ran(runner)
    got = {row[0]: row[3] for row in rows(runner)}
    first = {4: 16.5, 5: 16.5, 6: 36.5}
    second = {14: 196.5, 15: 196.5, 16: 256.5}
    assert got == dict.fromkeys(range(20)) | first | second


def test_switching_skipping_off_runs_every_stage_in_every_frame(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"level": {"when": REPEAT}}, skipping=False)
    ran(runner)
    for name in ("level", "heavy", "gated", "join"):
        assert seen(runner, name) == list(range(20))


@pytest.mark.parametrize("wants_any", [True, False])
def test_only_what_a_sink_wants_is_computed_but_memory_is_kept(
    toy_runner: MakeRunner, wants_any: bool
) -> None:
    runner = toy_runner(sinks={"out": {"use": "Collect", "max_rate": 10}})
    runner.pipeline.nodes["out"].component.cls.wanted = wants_any
    result = ran(runner)
    wanted = [0, 5, 10, 15] if wants_any else []
    assert seen(runner, "out") == seen(runner, "join") == wanted
    assert seen(runner, "total") == list(range(20)), "a stateful stage sees every accepted frame"
    assert result.stats["stages"]["join"]["skips"] == {"no_demand": 20 - len(wanted)}


def test_a_stage_that_no_sink_needs_is_not_built_and_gives_a_warning(toy_runner: MakeRunner) -> None:
    runner = toy_runner(sinks={"out": {"use": "OnlyLevel"}})
    assert {node.id for node in runner.plan.pruned} == {"pulse", "heavy", "gated", "total", "join"}
    assert "toy.yaml:" in runner.plan.warnings[0]
    assert "no sink needs" in runner.plan.warnings[0]
    ran(runner)
    assert set(runner.nodes) == {"level", "out"}


def test_an_absent_value_skips_the_stages_that_require_it_with_the_same_reason(
    toy_runner: MakeRunner,
) -> None:
    stages = {"rare": {"use": "Rare"}, "heavy": {"in": {"level": "rare.number"}}, "gated": {"when": []}}
    runner = toy_runner(stages)
    result = ran(runner)
    assert seen(runner, "heavy") == [i for i in range(20) if i % 3]
    assert result.stats["stages"]["gated"]["skips"] == {"third": 7}
    assert rows(runner)[3][4] == {"gated": "third"}


def test_an_optional_input_that_nothing_is_connected_to_is_none(toy_runner: MakeRunner) -> None:
    runner = toy_runner(dict.fromkeys(("heavy", "gated", "join")))
    ran(runner)
    assert rows(runner) == [(i, None, sum(range(i + 1)), None, {}) for i in range(20)]


# -- references -------------------------------------------------------------------------------------------


def test_a_new_reference_resets_stateful_stages_between_two_frames(toy_runner: MakeRunner) -> None:
    for cut in ({}, SEGMENTS["each"]):
        runner = toy_runner({**cut, "capture": {"retake_at": 10}})
        ran(runner)
        totals = [row[2] for row in rows(runner)]
        assert totals[9] == sum(range(10))
        assert totals[19] == sum(range(10, 20))
        assert runner.nodes["total"].instance.resets == 1


def test_a_reference_image_is_seen_by_stateful_stages_and_by_no_sink(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"capture": {"preroll": True}})
    result = ran(runner)
    assert seen(runner, "total")[0] == -1
    assert [row[0] for row in rows(runner)] == list(range(20))
    assert result.stats["frames"] == 20


ASKING: dict[str, Any] = {"doubtful": {"use": "Doubtful"}}
FRAMES: dict[str, Any] = {"out": {"use": "Frames"}}


@pytest.mark.parametrize("segment", [None, "capture"])
def test_a_stage_gets_the_very_next_frame_as_a_new_reference(
    toy_runner: MakeRunner, segment: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    names = ("level", "pulse", "heavy", "gated", "total", "join", "doubtful")
    cut = {name: {} if segment is None else {"segment": segment} for name in names}
    cut["doubtful"] = cut["doubtful"] | ASKING["doubtful"]
    runner = toy_runner(cut, FRAMES)
    with caplog.at_level(logging.INFO, "tactflow"):
        ran(runner)
    assert [row[:3] for row in rows(runner)] == [(i, i in (0, 8), int(i >= 8)) for i in range(20)]
    assert [row[3] for row in rows(runner) if row[3]] == [{"reference": "light_changed"}]
    assert runner.nodes["level"].stage is not None
    assert "frame 7: doubtful takes a new reference: light changed" in caplog.messages


def test_a_stage_that_runs_in_another_segment_does_not_change_which_frame_becomes_the_reference(
    toy_runner: MakeRunner,
) -> None:
    runner = toy_runner({**ASKING, "heavy": {"segment": "other"}}, FRAMES)
    ran(runner)
    assert [row[0] for row in rows(runner) if row[1]] == [0, 8]


def test_a_new_reference_resets_other_stages_and_reaches_sinks_that_take_references(
    toy_runner: MakeRunner,
) -> None:
    runner = toy_runner(ASKING, {**FRAMES, "rows": {"use": "Collect"}, "kept": {"use": "References"}})
    ran(runner)
    assert rows(runner, "rows")[19][2] == sum(range(8, 20))
    assert runner.nodes["total"].instance.resets == 1
    assert rows(runner, "kept") == [0, 8]


def test_where_other_stages_run_ahead_the_source_is_asked_for_a_new_reference(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"doubtful": {"use": "Doubtful", "segment": "other"}}, FRAMES)
    ran(runner)
    assert not any(row[2] for row in rows(runner))
    assert runner.source is not None
    assert vars(runner.source)["retakes"] == 1


# -- errors -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [{}, SEGMENTS["each"]], ids=["default", "each"])
@pytest.mark.parametrize("stage", ["level", "total", "join"])
def test_a_stage_that_raises_ends_the_run_with_what_and_where(
    toy_runner: MakeRunner, stage: str, cut: dict[str, Any]
) -> None:
    runner = toy_runner({**cut, stage: {**cut.get(stage, {}), "fail_at": 7}})
    result = runner.run()
    assert result.exit_code == 3
    assert result.error is not None
    assert f"{stage} failed at frame 7: ArithmeticError: cannot count 7" in result.error
    assert "in " + str(runner.pipeline.directory / "toys.py:") in result.error
    assert "toy.yaml:" in result.error
    assert "inputs: " in result.error
    assert result.stats["end"].startswith(f"error: {stage} failed at frame 7")
    if not cut:
        assert [row[0] for row in rows(runner)] == list(range(7)), "what was done before is delivered"
    for node in runner.nodes.values():
        assert node.instance.closed == node.instance.opened == 1
    assert runner.source.closed == 1


def test_skipping_frames_has_a_budget(toy_runner: MakeRunner, caplog: pytest.LogCaptureFixture) -> None:
    runner = toy_runner({"total": {"fail_at": 7, "on_error": {"action": "skip_frame", "budget": 2}}})
    with caplog.at_level(logging.WARNING, "tactflow"):
        result = ran(runner)
    assert rows(runner)[6][2] == 21
    assert len(rows(runner)) == 20
    assert rows(runner)[7][4]["total"] == "error"
    assert result.stats["stages"]["total"]["errors"] == 1
    assert "frame skipped (1 of 2)" in caplog.text

    runner = toy_runner({"total": {"fail_from": 7, "on_error": {"action": "skip_frame", "budget": 2}}})
    failed = runner.run()
    assert failed.exit_code == 3
    assert "budget of 2 skipped frames is used up" in str(failed.error)
    assert [row[0] for row in rows(runner)] == list(range(9))


def test_a_disabled_stage_lets_the_rest_go_on(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"gated": {"fail_at": 4, "on_error": "disable"}})
    result = ran(runner)
    assert [row[3] for row in rows(runner)].count(None) == 19
    assert result.stats["stages"]["gated"]["skips"]["disabled"] == 7


def test_a_failing_data_sink_ends_the_run_and_a_failing_viewer_does_not(toy_runner: MakeRunner) -> None:
    result = toy_runner(sinks={"out": {"use": "Collect", "fail_at": 5}}).run()
    assert result.exit_code == 3
    assert "out failed at frame 5" in str(result.error)
    runner = toy_runner(
        sinks={
            "out": {"use": "Collect"},
            "view": {"use": "ThreadedCollect", "fail_at": 5, "on_error": "disable"},
        }
    )
    ran(runner)
    assert len(rows(runner)) == 20
    assert len(rows(runner, "view")) == 5


def test_a_source_that_cannot_be_opened_is_named_with_its_line(toy_runner: MakeRunner) -> None:
    result = toy_runner({"capture": {"refuse": True}}).run()
    assert result.exit_code == 4
    assert "cannot be opened: OSError: no such device" in str(result.error)
    assert "toys.py:" in str(result.error)


# -- checks -----------------------------------------------------------------------------------------------


def test_inputs_cannot_be_written_to_under_check(toy_runner: MakeRunner) -> None:
    vandal = {"vandal": {"use": "Vandal"}, "heavy": {"in": {"level": "vandal.number"}}, "gated": {"when": []}}
    result = toy_runner(vandal, check=True).run()
    assert result.exit_code == 3
    assert "read-only" in str(result.error)


def test_a_wrong_shape_is_caught_under_check(toy_runner: MakeRunner) -> None:
    stages = {
        "bad": {"use": "BadShape"},
        "vandal": {"use": "Vandal", "in": {"grid": "bad.half"}},
        "gated": {"when": []},
    }
    runner = toy_runner({**stages, "heavy": {"in": {"level": "vandal.number"}}}, check=True)
    result = runner.run()
    assert result.exit_code == 3
    assert "port half: required shape (H, W) with H = 4, W = 6, got (2, 6)" in str(result.error)
    where = runner.nodes["bad"].node.component.cls.process.__code__  # type: ignore[attr-defined]
    assert f"  in {where.co_filename}:{where.co_firstlineno}\n" in str(result.error)


# -- live -------------------------------------------------------------------------------------------------


def test_frames_that_were_overtaken_inside_the_source_count_as_dropped(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"capture": {"overtaken": 7}}, sinks={"out": {"use": "Collect"}})
    result = ran(runner)
    assert (result.stats["frames"], result.stats["dropped"]) == (20, 7)
    assert (runner.progress().frames, runner.progress().dropped) == (20, 7)


def test_a_live_source_drops_rather_than_lags_and_counts_it(toy_runner: MakeRunner) -> None:
    runner = toy_runner(
        {
            "capture": {"realtime": True, "frames": 300, "pause": 0.001},
            "heavy": {"seconds": 0.01},
            "gated": {"when": []},
        }
    )
    result = ran(runner)
    got = [row[0] for row in rows(runner)]
    assert got == sorted(set(got))
    assert got[0] == 0, "the reference frame is never dropped"
    assert result.stats["dropped"] > 0
    assert len(got) + result.stats["dropped"] == 300
    link = result.stats["links"]["capture->compute"]
    assert link["policy"] == "latest"
    assert link["high_water"] == 1, "no frame waits behind another: the lag cannot grow"
    assert link["drops"] + link["delivered"] == link["offered"] == 300


def test_frames_that_one_branch_dropped_are_dropped_at_the_join(toy_runner: MakeRunner) -> None:
    stages = {name: dict(body) for name, body in SEGMENTS["each"].items()}
    stages["total"]["queue"] = {"capacity": 1, "when_full": "latest"}
    stages["total"]["seconds"] = 0.005
    runner = toy_runner({**stages, "capture": {"frames": 60}})
    result = ran(runner)
    got = [row[0] for row in rows(runner)]
    assert got == sorted(set(got))
    assert got == [i for i in seen(runner, "total") if i in set(got)]
    for link in result.stats["links"].values():
        assert link["offered"] == link["delivered"] + link["drops"]


def test_the_run_stops_after_the_frames_asked_for(toy_runner: MakeRunner) -> None:
    runner = toy_runner(max_frames=6)
    result = ran(runner)
    assert [row[0] for row in rows(runner)] == list(range(6))
    assert result.stats["end"] == "max_frames"


def test_a_paused_recording_waits_and_steps_frame_by_frame(toy_runner: MakeRunner) -> None:
    runner = toy_runner({"capture": {"frames": 12}})
    runner.pause(True)
    thread = threading.Thread(target=runner.run)
    thread.start()
    for count in (1, 2, 3):
        runner.step()
        until(lambda count=count: "out" in runner.nodes and len(rows(runner)) >= count)
        assert [row[0] for row in rows(runner)] == list(range(count))
    assert runner.paused
    runner.pause(False)
    thread.join(PATIENCE)
    assert [row[0] for row in rows(runner)] == list(range(12)), "nothing is lost by pausing"
    assert runner.snapshot()["frames"] == 12


def test_a_paused_run_can_be_stopped(toy_runner: MakeRunner) -> None:
    runner = toy_runner()
    runner.pause(True)
    thread = threading.Thread(target=runner.run)
    thread.start()
    runner.stop()
    thread.join(PATIENCE)
    assert not thread.is_alive()


def test_a_run_that_is_stopped_before_its_sinks_are_open_opens_none(toy_runner: MakeRunner) -> None:
    runner = toy_runner()
    runner.stop()
    result = ran(runner)
    assert (result.stats["frames"], result.stats["end"]) == (0, "signal")
    assert not runner.nodes


def test_a_slow_stage_may_finish_what_waits_after_a_stop(
    toy_runner: MakeRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactflow.engine.threads.CLOSE_SECONDS", 1.0)
    queue = {"capacity": 8, "when_full": "block"}
    slow = {"join": {"seconds": 0.02, "segment": "slow", "queue": queue}, "capture": {"frames": 10_000}}
    runner = toy_runner(slow)

    def clock() -> float:
        """As if the stage took 0.2 s for a frame, and nothing else any time."""
        return 0.2 * len(seen(runner, "join")) if "join" in runner.nodes else 0.0

    monkeypatch.setattr("tactflow.engine.threads.time", SimpleNamespace(perf_counter=clock))

    def stop_when_full(_: object) -> None:
        if any(link["high_water"] == 8 for link in runner.snapshot()["links"].values()):
            runner.stop()

    result = runner.run(on_progress=stop_when_full)
    assert (result.exit_code, result.stats["end"]) == (0, "signal")
    assert [row[0] for row in rows(runner)] == list(range(result.stats["frames"]))


def test_a_run_of_no_frames_is_a_mistake(toy_runner: MakeRunner) -> None:
    with pytest.raises(Exception, match="max_frames: required a whole number from 1"):
        toy_runner(max_frames=0)


def test_a_stage_that_hangs_is_named(toy_runner: MakeRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactflow.engine.threads.CLOSE_SECONDS", 0.2)
    runner = toy_runner({"join": {"seconds": 60}, "capture": {"frames": 3}})
    result = runner.run(on_progress=lambda _: runner.stop())
    assert result.exit_code == 3
    assert "compute (in join) hangs" in str(result.error)
    runner.nodes["join"].instance.release.set()
    until(lambda: not threads_of_runs())


def interrupt_in_join(runner: Runner) -> RunResult:
    """Run, and interrupt as soon as `join` is being called."""

    def interrupt(_: object) -> None:
        if runner.nodes["join"].instance.called.is_set():
            raise KeyboardInterrupt

    return runner.run(on_progress=interrupt, interval_s=0.001)


def test_nothing_is_closed_while_a_thread_is_in_it(
    toy_runner: MakeRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactflow.engine.threads.LEAVE_SECONDS", 0.1)
    runner = toy_runner({"join": {"seconds": PATIENCE}, "capture": {"frames": 3}})
    assert interrupt_in_join(runner).exit_code == INTERRUPTED_EXIT_CODE
    closed = {name: node.instance.closed for name, node in runner.nodes.items()}
    assert closed.pop("join") == 0
    assert set(closed.values()) == {1}
    runner.nodes["join"].instance.release.set()
    until(lambda: not threads_of_runs())


def test_an_interrupted_run_lets_its_threads_end_before_it_closes(
    toy_runner: MakeRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactflow.engine.threads.LEAVE_SECONDS", PATIENCE)
    runner = toy_runner({"join": {"seconds": 0.2}, "capture": {"frames": 3}})
    assert interrupt_in_join(runner).exit_code == INTERRUPTED_EXIT_CODE
    assert not threads_of_runs()
    assert runner.nodes["join"].instance.closed == 1


def test_an_interrupt_while_one_part_is_closed_reaches_the_caller_when_the_others_are_closed(
    toy_runner: MakeRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    runner = toy_runner()
    monkeypatch.setattr(runner.pipeline.nodes["join"].component.cls, "close", interrupted, raising=False)
    with pytest.raises(KeyboardInterrupt):
        runner.run()
    closed = {name: node.instance.closed for name, node in runner.nodes.items() if name != "join"}
    assert set(closed.values()) == {1}
    assert runner.source is not None
    assert runner.source.closed == 1  # type: ignore[attr-defined]


# -- the graph --------------------------------------------------------------------------------------------


def test_segments_that_form_a_cycle_are_refused(toy_runner: MakeRunner) -> None:
    with pytest.raises(Exception, match="form a cycle") as caught:
        toy_runner({"level": {"segment": "a"}, "heavy": {"segment": "b"}, "gated": {"segment": "a"}})
    assert "toy.yaml:" in str(caught.value)
    assert type(caught.value).__name__ == "ConfigError"


def test_a_frame_whose_source_does_not_say_when_it_was_captured_gets_the_time_at_which_it_came(
    toy_runner: MakeRunner,
) -> None:
    runner = toy_runner({"capture": {"says_when": False}})
    before = time.perf_counter()
    ran(runner)
    captured = runner.nodes["out"].instance.captured
    assert captured
    assert captured == sorted(captured)
    assert before <= captured[0] <= captured[-1] <= time.perf_counter()


def test_statistics_have_the_promised_shape(toy_runner: MakeRunner) -> None:
    stats = ran(toy_runner()).stats
    assert {"frames", "dropped", "wall_s", "end", "stages", "links", "latency_ms"} <= set(stats)
    for stage in stats["stages"].values():
        assert {"runs", "skips", "p50_ms", "p99_ms"} <= set(stage)
    for link in stats["links"].values():
        assert {"policy", "capacity", "high_water", "drops", "blocked_s"} <= set(link)
    assert stats["latency_ms"]["p50"] <= stats["latency_ms"]["p99"]

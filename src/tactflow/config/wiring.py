"""Connects the inputs and gates of stages and sinks to outputs, and orders them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from tactflow.config.document import Document, Keys, dotted
from tactflow.config.registry import Section, catalogue
from tactflow.config.replacements import grouped
from tactflow.engine.contract import StageParams
from tactflow.engine.graph import Component, Gate, Mark, Ref
from tactflow.engine.ports import Port, SignalPort, describe_type, fits, port_type
from tactflow.system.spelling import did_you_mean


@dataclass(slots=True)
class Draft:
    """A stage or sink of the file before its inputs are connected.

    Attributes
    ----------
    mark : of its key.
    component : None if `use` could not be resolved; no errors are reported for nodes that depend on it.
    params : None if invalid.
    inputs, gates : set by `connect`.
    edges : every output that it uses, with the location in the file.
    """

    id: str
    section: Section
    mark: Mark
    component: Component | None = None
    params: StageParams | None = None
    inputs: dict[str, Ref | None] = field(default_factory=dict)
    gates: list[Gate] = field(default_factory=list)
    edges: list[tuple[Ref, Mark]] = field(default_factory=list)

    @property
    def keys(self) -> Keys:
        """Its path in the document."""
        return (self.section, self.id)

    @property
    def outputs(self) -> dict[str, Port]:
        """Its output ports by name."""
        return {port.name: port for port in self.component.ports.outputs} if self.component else {}


def connect(drafts: Sequence[Draft], document: Document) -> None:
    """Connect every input and gate, by name or by `in:` and `when:`; errors are recorded.

    By default, an input takes the output of its name from the nearest stage above; in a sink, from the last
    stage that has it.
    """
    wiring = _Wiring(drafts, document)
    for draft in drafts:
        if draft.component is not None:
            wiring.connect_inputs(draft, draft.component)
    for draft in drafts:
        if draft.component is not None:
            wiring.connect_gates(draft, draft.component)


def ordered(drafts: Sequence[Draft], document: Document) -> list[Draft]:
    """Sort topologically, else in the order of the file; reports a cycle."""
    by_id = {draft.id: draft for draft in drafts}
    done: dict[str, Draft] = {}
    chain: list[str] = []

    def visit(draft: Draft) -> None:
        if draft.id in done:
            return
        if draft.id in chain:
            # Each takes an output of the next.
            cycle = [*chain[chain.index(draft.id) :], draft.id]
            mark = next(mark for ref, mark in draft.edges if ref.node == cycle[1])
            ring = " -> ".join(cycle[::-1])
            document.report_at(mark, f"{dotted(draft.keys)}: the stages form a cycle, {ring}")
            return
        chain.append(draft.id)
        for ref, _ in draft.edges:
            visit(by_id[ref.node])
        chain.pop()
        done[draft.id] = draft

    for draft in drafts:
        visit(draft)
    return list(done.values())


class _Wiring:
    def __init__(self, drafts: Sequence[Draft], document: Document) -> None:
        self._document = document
        self._by_id = {draft.id: draft for draft in drafts}
        self._stages = [draft for draft in drafts if draft.section == "stages"]
        self._complete = all(draft.component is not None for draft in self._stages)

    def connect_inputs(self, draft: Draft, component: Component) -> None:
        document = self._document
        explicit = document.mapping(*draft.keys, "in")
        names = [port.name for port in component.ports.inputs]
        for name in explicit.keys() - set(names):
            hint = did_you_mean(name, names, "inputs: ") if names else "; a source has no inputs"
            document.report((*draft.keys, "in", name), f"{draft.id} has no input {name}{hint}")
        unused = draft.params.unused_inputs() if draft.params else ()
        for port in component.ports.inputs:
            draft.inputs[port.name] = None
            place, mark, ref = draft.keys, draft.mark, None
            if port.name in explicit:
                place = (*draft.keys, "in", port.name)
                mark = document.mark(*place)
                if explicit[port.name] is not None:
                    ref = self._reference(explicit[port.name], place, draft)
                elif not port.optional:
                    document.report(place, "this input is required; name the output to take")
            elif not (port.optional and port.name in unused):
                ref = self._nearest(port.name, draft)
                if ref is None and not port.optional and self._complete:
                    document.report(place, self._dangling(port, draft))
            if ref is not None:
                draft.inputs[port.name] = ref
                draft.edges.append((ref, mark))
                output, producer = self._output(ref), self._by_id[ref.node].mark
                if not fits(output, port):
                    document.report_at(
                        mark,
                        f"{dotted(place)}: the input {port.name} takes {describe_type(port.annotation)}, but "
                        f"{ref} ({producer}) gives {describe_type(output.annotation)}",
                    )

    def connect_gates(self, draft: Draft, component: Component) -> None:
        place: Keys = (*draft.keys, "when")
        when = self._document.get(*place)
        if when is None:
            return
        if component.kind == "source":
            message = "a source cannot be gated; gate the stages behind it"
            self._document.report(place, message)
            return
        for index, signal in enumerate(when if isinstance(when, list) else [when]):
            self._gate(signal, (*place, index) if isinstance(when, list) else place, draft)

    def _reference(self, text: Any, place: Keys, user: Draft) -> Ref | None:
        """The output named by `stage.port`, or by the name of a port: that of the nearest stage above."""
        if not isinstance(text, str):
            # Reported by the model of the file.
            return None
        stage, dot, port = text.partition(".")
        if not dot:
            ref = self._nearest(text, user)
            if ref is None and self._complete:
                self._document.report(place, self._unknown(text))
            return ref
        producer = self._by_id.get(stage)
        if producer is None:
            hint = did_you_mean(stage, [draft.id for draft in self._stages], "stages: ")
            self._document.report(place, f"there is no stage {stage!r}{hint}")
        elif port in producer.outputs:
            return Ref(stage, port)
        elif producer.component is not None:
            hint = did_you_mean(port, producer.outputs, "it gives ")
            self._document.report(place, f"{stage} ({producer.mark}) has no output {port!r}{hint}")
        return None

    def _unknown(self, name: str) -> str:
        """Why no stage above gives a port."""
        ports = {port: f"{draft.id}.{port}" for draft in self._stages for port in draft.outputs}
        if name in ports:
            return f"no stage above gives {name}; write {ports[name]}"
        if name in self._by_id:
            outputs = " or ".join(f"{name}.{port}" for port in self._by_id[name].outputs)
            return f"{name} is the name of a stage; required an output, {outputs}"
        return f"no stage gives {name!r}{did_you_mean(name, ports, 'there are ')}"

    def _above(self, user: Draft) -> list[Draft]:
        """The stages whose outputs an input may take by name, nearest first."""
        stages = self._stages if user.section == "sinks" else self._stages[: self._stages.index(user)]
        return stages[::-1]

    def _nearest(self, port: str, user: Draft) -> Ref | None:
        return next((Ref(draft.id, port) for draft in self._above(user) if port in draft.outputs), None)

    def _output(self, ref: Ref) -> Port:
        return self._by_id[ref.node].outputs[ref.port]

    def _signal(self, ref: Ref) -> SignalPort | None:
        kind = port_type(self._output(ref).annotation)
        return kind if isinstance(kind, SignalPort) else None

    def _dangling(self, port: Port, user: Draft) -> str:
        where = "" if user.section == "sinks" else " above"
        outputs = [f"{name} ({draft.id})" for draft in reversed(self._above(user)) for name in draft.outputs]
        text = f"needs {port.name}, but no stage{where} gives it"
        below = next((draft for draft in self._stages if port.name in draft.outputs), None)
        if below is not None and below is not user:
            text += f"; {below.id} gives it but is below: move it up, or write in: "
            return text + f"{{{port.name}: {below.id}.{port.name}}}"
        # Of stages that can replace each other, the usual one.
        known_stages = (component for component, _ in grouped(catalogue()[0]))
        makers = [c.name for c in known_stages if port.name in (output.name for output in c.ports.outputs)]
        known = f"there are {', '.join(outputs)}" if outputs else "there are none"
        return f"{text}; {known}" + (f"; it comes from the stage {' or '.join(makers)}" if makers else "")

    def _gate(self, text: Any, place: Keys, draft: Draft) -> None:
        ref = self._reference(text, place, draft)
        if ref is None:
            return
        signal = self._signal(ref)
        if signal is None:
            kind, producer = describe_type(self._output(ref).annotation), self._by_id[ref.node].mark
            needed = "a gate takes a signal (a bool port such as touching)"
            self._document.report(place, f"{needed}, but {ref} ({producer}) gives {kind}")
            return
        meaning = self._meaning(ref, signal)
        draft.gates.append(Gate(ref, meaning.closed or ref.port, meaning.otherwise))
        draft.edges.append((ref, self._document.mark(*place)))

    def _meaning(self, ref: Ref, signal: SignalPort, visited: Sequence[str] = ()) -> SignalPort:
        """The signal that defines a closed gate: for a stage that holds a signal, the held one."""
        producer = self._by_id[ref.node]
        only_holds = signal.closed is None and producer.id not in visited
        for source in producer.inputs.values() if only_holds else ():
            held = self._signal(source) if source else None
            if source and held:
                return self._meaning(source, held, [*visited, producer.id])
        return signal

"""Parameters of a sink that publishes results, and may take commands."""

from __future__ import annotations

from typing import Self

from pydantic import Field, field_validator, model_validator

from tactflow.engine.contract import StageParams
from tactflow.network.address import Address


class PublisherParams(StageParams):
    """Address, queue, and access of subscribers and of commands.

    Sinks of several sensors may publish at one endpoint.
    """

    endpoint: str = Field(
        "tcp://127.0.0.1:5556",
        description="address: tcp://127.0.0.1:PORT (* picks a free port) or ipc:///PATH on this machine, "
        "tcp://*:PORT for the network, which requires keys",
    )
    keys: str | None = Field(
        None,
        min_length=1,
        description="publisher's folder of tactflow keys new: only its subscribers are admitted",
    )
    open_to_all: bool = Field(False, description="let everybody on other machines read, without keys")
    backlog: int = Field(
        32,
        ge=1,
        le=2**31 - 1,
        description="messages queued for each subscriber; more bridge longer pauses, fewer are fresher",
    )
    linger: float = Field(1.0, ge=0, le=60, description="time to deliver the last messages, s")
    control: str | None = Field(
        None,
        min_length=1,
        description="address for commands, such as tcp://127.0.0.1:5557; null: none",
    )
    control_keys: str | None = Field(
        None, min_length=1, description="folder of keys for commands; null: same as keys"
    )

    @field_validator("endpoint", "control")
    @classmethod
    def _is_an_address(cls, endpoint: str | None) -> str | None:
        return endpoint and Address.parse(endpoint).text

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if self.keys is None and not self.open_to_all and not Address.parse(self.endpoint).is_local:
            raise ValueError(
                f"{self.endpoint} can be reached from other machines, so keys are required: make some "
                "with tactflow keys new and set keys to the publisher's folder, or endpoint to "
                "tcp://127.0.0.1:5556; open_to_all: true lets everybody read"
            )
        open_control = self.control is not None and not Address.parse(self.control).is_local
        if open_control and self.commanders is None:
            raise ValueError(
                f"{self.control} can be reached from other machines, so commands require keys: make some "
                "with tactflow keys new and set keys or control_keys to the publisher's folder, or "
                "control to tcp://127.0.0.1:5557"
            )
        return self

    @property
    def commanders(self) -> str | None:
        """The folder of keys for commands; None: everybody who can reach the address."""
        return self.control_keys or self.keys

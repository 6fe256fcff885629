"""The kinds of faults by name, and the form of the command line."""

import pytest

from gateway.errors import ConfigError
from gateway.simulator.faults.base import Fault
from gateway.simulator.faults.frame_faults import WrongByteOrder
from gateway.simulator.faults.kinds import KINDS, describe_kinds, parse_fault, summary_of
from gateway.simulator.faults.reply_faults import RefusedCommands
from gateway.simulator.faults.server_faults import Restart
from gateway.simulator.faults.stream_faults import Delay, Jitter
from gateway.simulator.scene_settings import SceneSettings


def test_every_kind_of_fault_has_defaults_for_all_parameters() -> None:
    assert set(KINDS) == {
        *("delay", "jitter", "split", "merge", "cut", "half_open", "slow_reader", "garbage"),
        *("oversize", "undersize", "wrong_counts", "wrong_byte_order", "unknown_component"),
        *("refused_commands", "minimal_server", "reply_text", "frames_first"),
        *("doubled_acknowledgements", "missing_acknowledgements", "late_acknowledgements"),
        *("no_measurement", "restart", "change_scene", "rename", "occlusion"),
        *("frozen_timestamps", "jumping_timestamps", "constant_frame_numbers", "short_events"),
    }
    for name, kind in KINDS.items():
        assert parse_fault(name) == kind()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("delay,delay_ms=80,at_s=5,for_s=3", Delay(delay_ms=80, at_s=5, for_s=3)),
        ("jitter,mean_ms=5", Jitter(mean_ms=5)),
        (
            "restart,scene.markers=12,scene.marker_label=M",
            Restart(scene=SceneSettings(markers=12, marker_label="M")),
        ),
        ("refused_commands,commands=[version,bye]", RefusedCommands(commands=("version", "bye"))),
        ("refused_commands,commands=bye,times=2", RefusedCommands(commands=("bye",), times=2)),
        (
            "wrong_byte_order,byte_order=little,connection=2",
            WrongByteOrder(byte_order="little", connection=2),
        ),
    ],
)
def test_a_fault_is_parsed_from_the_form_in_which_it_is_printed(text: str, fault: Fault) -> None:
    assert parse_fault(text) == fault
    assert parse_fault(str(fault)) == fault


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "dely,at_s=1",
            r"fault 'dely,at_s=1': fault: found 'dely' \(did you mean 'delay'\?\); expected no_me",
        ),
        ("", "fault '': fault: found ''; expected no_measurement,"),
        ("cut,at=1", r"at: unknown key \(did you mean 'at_s'\?\); known keys: at_s, every_s, times"),
        ("cut,reset=1", "reset: found 1; expected true or false"),
        *(
            (f"cut,{each}", f"found '{each.split(',')[-1]}'; expected NAME=VALUE, each name once")
            for each in ("reset", "at_s=1,at_s=2", "fault=delay")
        ),
        ("delay,delay_ms=-1", "delay_ms: found -1; expected a number of milliseconds above 0, up to 600000"),
        ("delay,delay_ms=[", r"delay_ms: found '\['; expected a number"),
        ("delay,delay_ms=.nan", "delay_ms: found nan; expected a number"),
        ("delay,every_s=2", "every_s: found every_s without for_s; expected both"),
        ("restart,scene=3", "scene: found 3; expected a mapping with any of the keys markers, tools"),
        ("restart,scene=3,scene.markers=1", "scene has both a value and keys; expected only one of them"),
        ("restart,scene.markers=1.5", "scene.markers: found 1.5; expected a whole number from 0 to 10000"),
        ("refused_commands,commands=[]", "found an empty list; expected the first word of a command"),
        ("refused_commands,commands=[fly]", "commands.0: found 'fly'; expected version, setbyteorder"),
    ],
)
def test_an_invalid_fault_is_reported_in_a_sentence(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse_fault(text)


def test_the_description_of_the_kinds_has_each_with_its_parameters() -> None:
    text = describe_kinds()
    for name, kind in KINDS.items():
        assert f"\n{name}" in f"\n{text}"
        assert f"    {summary_of(kind)}" in text
        for parameter in kind.model_fields:
            assert parameter in text
    assert "delay_ms=100  The delay in milliseconds." in text

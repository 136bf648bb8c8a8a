"""`dragrig gap effects`: the catalogue as a person and as a program read it."""

import json

from click.testing import CliRunner

from dragrig.cli.commands import dragrig_group
from dragrig.sim_backend.effects.base import catalogue


def output_of(*arguments: str) -> str:
    done = CliRunner().invoke(dragrig_group, ["gap", *arguments])
    assert done.exit_code == 0, done.output
    return done.output


def test_every_effect_is_told_with_its_parameters_and_its_source() -> None:
    text = output_of("effects")
    for effect in catalogue().values():
        assert f"\n{effect.id}\n" in text
        assert effect.source in text
        for parameter in effect.parameters:
            assert f"\n{parameter.name} " in text


def test_as_json_it_holds_what_a_program_needs_to_set_an_effect() -> None:
    effects = {effect["id"]: effect for effect in json.loads(output_of("effects", "--json"))["effects"]}
    assert effects.keys() == catalogue().keys()
    ratio = effects["stribeck"]["parameters"][0]
    assert (ratio["name"], ratio["unit"], ratio["role"]) == ("ratio", "1", "size")
    assert ratio["low"] <= ratio["usual"] <= ratio["high"]


def test_without_a_command_the_group_says_what_there_is() -> None:
    assert "effects" in output_of()


def test_effects_have_names_for_sentences() -> None:
    names = {effect["id"]: effect["name"] for effect in json.loads(output_of("effects", "--json"))["effects"]}
    assert names["stribeck"] == "Stribeck friction"
    assert names["velocity_ripple"] == "velocity ripple"
    assert not any("_" in name for name in names.values())
    assert len(set(names.values())) == len(names)

"""The documents name every command, option, setting and word, and their links lead somewhere."""

from __future__ import annotations

import argparse
import dataclasses
import re
from enum import StrEnum
from pathlib import Path

import pytest

from rodif_core import spec
from server import states
from server.schemas.campaigns import CampaignSettings, CollectSettings
from server.settings import Settings
from worker.cli.main import build_parser

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [*sorted(ROOT.glob("*.md")), *sorted(DOCS.rglob("*.md"))]
ENUMS = [
    value
    for module in (spec, states)
    for value in vars(module).values()
    if isinstance(value, type) and issubclass(value, StrEnum) and value is not StrEnum
]
CONFIGS = (spec.FinetuneConfig, spec.GuideConfig, spec.RolloutConfig)


def text_of(name: str) -> str:
    return (DOCS / name).read_text()


@pytest.mark.parametrize("enum", ENUMS, ids=lambda enum: enum.__name__)
def test_every_value_of_an_enum_stands_in_the_glossary(enum: type[StrEnum]):
    missing = [member.value for member in enum if f"`{member.value}`" not in text_of("glossary.md")]
    assert missing == []


def test_every_environment_setting_is_documented_with_its_default():
    text = text_of("configuration.md")
    for name, field in Settings.model_fields.items():
        row = re.search(rf"^\| `RODIF_{name.upper()}` \|(.*)$", text, flags=re.MULTILINE)
        assert row, name
        if isinstance(field.default, int | float) and not isinstance(field.default, bool):
            assert f"| {field.default:g} |" in row.group(0), name


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.__name__)
def test_every_field_of_a_configuration_is_documented_with_its_default(config: type):
    sections = re.split(r"^## ", text_of("configuration.md"), flags=re.MULTILINE)
    section = next(part for part in sections if part.startswith(f"{config.__name__}\n"))
    for field in dataclasses.fields(config):
        default = getattr(config(), field.name)
        shown = "" if dataclasses.is_dataclass(default) else default_text(default)
        assert f"| `{field.name}` | {shown}".rstrip() in section, (field.name, shown)


def default_text(value: object) -> str:
    if isinstance(value, StrEnum):
        return f"`{value}` |"
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value) + " |"
    if value is None or isinstance(value, bool):
        return f"{'null' if value is None else str(value).lower()} |"
    return f"{value:g} |"


@pytest.mark.parametrize("page", ["api.md", "commands.md", "configuration.md", "equations.md"])
def test_every_method_stands_where_methods_are_listed(page: str):
    text = text_of(page)
    missing = [name for name in spec.FinetuneMethod if not re.search(rf"`{name}(_loss)?`", text)]
    assert missing == []


def test_the_dialogs_offer_every_method():
    script = (ROOT / "labeling_ui/site/static/campaign-actions.js").read_text()
    offered = re.search(r"const METHODS = \[(.*?)\n\];", script, flags=re.DOTALL)
    assert offered, "no METHODS"
    names = re.findall(r'^\s*\["(\w+)",', offered.group(1), flags=re.MULTILINE)
    assert names == [name.value for name in spec.FinetuneMethod]


@pytest.mark.parametrize("architecture", spec.Architecture)
def test_every_architecture_has_a_row(architecture: spec.Architecture):
    assert f"| `{architecture.value}` |" in text_of("architectures.md")


@pytest.mark.parametrize("config", [CampaignSettings, CollectSettings])
def test_every_campaign_setting_is_documented(config: type):
    text = text_of("configuration.md")
    for name in config.model_fields:
        assert f"`{name}`" in text, name


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Its own, and those of its subcommands."""
    own = {option for action in parser._actions for option in action.option_strings}
    return own.union(*(options_of(one) for one in subcommands(parser).values())) - {"-h", "--help"}


COMMANDS = subcommands(build_parser())
assert COMMANDS, "rodif has no commands"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_and_option_is_documented(name: str):
    sections = re.split(r"^## ", text_of("commands.md"), flags=re.MULTILINE)
    section = next((part for part in sections if part.startswith(f"rodif {name}\n")), None)
    assert section, f"no section for rodif {name}"
    for option in options_of(COMMANDS[name]):
        assert f"`{option}" in section, f"rodif {name} {option}"


@pytest.mark.parametrize("name", COMMANDS)
def test_no_section_names_an_option_that_does_not_exist(name: str):
    sections = re.split(r"^## ", text_of("commands.md"), flags=re.MULTILINE)
    section = next(part for part in sections if part.startswith(f"rodif {name}\n"))
    assert set(re.findall(r"`(--[a-z-]+)", section)) <= options_of(COMMANDS[name])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        target, _, anchor = link.partition("#")
        file = (page.parent / target).resolve() if target else page
        assert file.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(file), f"{page.name}: {link}"


def anchors(page: Path) -> set[str]:
    """Anchors of headings, as code hosts make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"\s", "-", heading) for heading in plain}

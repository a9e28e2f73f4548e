"""Another package's verb; the module of its settings needs no torch."""

from dataclasses import dataclass
from pathlib import Path

from ctm_plugin.settings.commands import Verb
from ctm_plugin.settings.setting import Settings, setting


@dataclass(frozen=True, kw_only=True)
class GreetConfig(Settings, section="greet"):
    times: int = setting(1, "how often", least=1)


def greet(name: Path, settings: GreetConfig) -> None:
    """Print a greeting."""
    print(f"hello {name}\n" * settings.times, end="")


GREET = Verb("greet somebody", "NAME", "outside_verb:greet", "outside_verb:GreetConfig")

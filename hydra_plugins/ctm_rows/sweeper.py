"""Hydra's sweeper for tables: ``hydra/sweeper=rows``."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.settings.as_typed import as_typed


class RowsSweeper(Sweeper):
    """Cartesian products, as Hydra's own sweeper has them, row by row.

    ``hydra.sweeper.rows`` lists sets of overrides, one for each row (or group of rows) of a table, and
    ``hydra.sweeper.scenes`` those of each scene that all rows are run on. Every row on every scene is combined with all
    choices of ``hydra.sweeper.params`` and of the command line; a row's own keys go before its scene's, these before
    the command line's, and these before ``params``. The same job is not run twice.

    Args:
        rows: overrides by key; values may be choices (``a,b``) or ``range(...)``.
        scenes: likewise; all rows are run on one before the next.
        params: overrides that all rows share.
    """

    def __init__(
        self,
        rows: Sequence[Mapping[str, Any]] = ({},),
        scenes: Sequence[Mapping[str, Any]] = ({},),
        params: Mapping[str, Any] | None = None,
    ):
        for key, sets in (("rows", rows), ("scenes", scenes)):
            if not sets:
                raise ConfigError(f"hydra.sweeper.{key}", sets, "a list of sets of overrides, at least one: [{}]")
        self.rows = [{**scene, **row} for scene in scenes for row in rows]
        self.params = dict(params or {})
        self.hydra_context: HydraContext | None = None
        self.config: DictConfig | None = None
        self.launcher: Launcher | None = None

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.hydra_context, self.config = hydra_context, config
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> list[JobReturn]:
        """Run all jobs; one that fails does not end the others.

        Raises:
            CTMError: the folder holds another sweep's runs, or jobs failed.
        """
        folder, going_on = Path(self.config.hydra.sweep.dir), self.config.sweep.resume
        check_folder(folder, going_on)
        jobs = self.jobs(arguments)
        self.validate_batch_is_legal(jobs)
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, folder / "multirun.yaml")
        returns = list(self.launcher.launch(jobs, initial_job_idx=0))
        from ctm_plugin.show.console import print_sweep  # needs torch, and every command line imports Hydra's plug-ins

        print_sweep(outcomes(jobs, returns, folder), folder)
        failed = sum(job.status != JobStatus.COMPLETED for job in returns)
        if failed:
            raise CTMError(
                f"{folder}: {failed} of {len(jobs)} runs failed; the same command with sweep.resume=true "
                f"{shlex.quote(f'hydra.sweep.dir={folder}')} runs what is not finished"
            )
        return returns

    def jobs(self, arguments: Sequence[str]) -> list[list[str]]:
        """The overrides of every job, in the table's order."""
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        shared = _overrides(self.params)
        jobs: list[list[str]] = []
        for row in self.rows:
            choices: dict[tuple[str, str | None], list[str]] = {}
            for given in parser.parse_overrides([*shared, *arguments, *_overrides(row)]):
                key, same = given.get_key_element(), (given.key_or_group, given.package)  # with a + or without
                if not given.is_sweep_override():
                    choices[same] = [f"{key}={given.get_value_element_as_str()}"]
                elif given.is_discrete_sweep():
                    choices[same] = [f"{key}={value}" for value in given.sweep_string_iterator()]
                else:
                    expected = "choices or a range: intervals are for sweepers that search"
                    raise ConfigError(key, given.input_line, expected)
            for job in map(list, itertools.product(*choices.values())):
                if sorted(job) not in map(sorted, jobs):
                    jobs.append(job)
        return jobs


def _overrides(row: Mapping[str, Any]) -> list[str]:
    """Values of YAML as overrides."""
    return [as_typed(f"{key}={'null' if value is None else value}", sweep=True) for key, value in row.items()]


def check_folder(folder: Path, going_on: Any) -> None:
    """Refuse to begin a sweep where another one is.

    Raises:
        ConfigError: ``sweep.resume`` is no boolean.
        CTMError: the folder holds runs, and nobody said to go on with them.
    """
    if not isinstance(going_on, bool):
        raise ConfigError("sweep.resume", going_on, "true or false")
    if not going_on and any(folder.glob("*/config.yaml")):
        raise CTMError(
            f"{folder}: found the runs of an earlier sweep, expected sweep.resume=true (finished ones are not run "
            "again), or another hydra.sweep.dir"
        )


def outcomes(
    jobs: Sequence[Sequence[str]], returns: Sequence[JobReturn], folder: Path
) -> list[tuple[str, dict[str, Any] | None]]:
    """Of each job what sets it apart from the others, and its scores; ``None`` for one that failed.

    Runs are found by their configuration, as when a sweep goes on: their folders may have other numbers.
    """
    from ctm_plugin.compose.command_line import without_hydras
    from ctm_plugin.runs.sweep import finished, same_run

    common = set.intersection(*(set(job) for job in jobs)) if len(jobs) > 1 else set()
    varied = {each.partition("=")[0] for job in jobs for each in job if each not in common}
    runs, found = finished(folder), []
    for job, done in zip(jobs, returns, strict=True):
        scores = None
        if done.status == JobStatus.COMPLETED:
            config = without_hydras(done.cfg)  # with what the job decided
            scores = next((metrics for saved, metrics in runs if same_run(saved, config)), {"psnr": done.return_value})
        # A row that does not name a group has the choice of the configuration: it would have no name.
        chosen = (done.hydra_cfg or {}).get("hydra", {}).get("runtime", {}).get("choices", {})
        given = {each.partition("=")[0] for each in job}
        left = [f"{key}={chosen[key]}" for key in sorted(varied - given) if key in chosen]
        found.append((" ".join([*(each for each in job if each not in common), *left]), scores))
    return found

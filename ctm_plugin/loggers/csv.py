"""Curves as a table."""

from __future__ import annotations

import csv
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.loggers.logger import rank_zero_experiment

from ctm_plugin.errors import CheckpointError
from ctm_plugin.files import replacing
from ctm_plugin.loggers.base import RunLogger


class CSV(RunLogger, CSVLogger):
    """Only curves, as a table: `csv/metrics.csv` in the run's folder, with one row a logged step."""

    def __init__(self, config: RunLogger.Config, run: Path, step: int):
        super().__init__(run, name="", version="csv")
        self.last = step

    @property
    @rank_zero_experiment
    def experiment(self) -> ExperimentWriter:
        if self._experiment is None:
            self._experiment = Rows(self.log_dir, self.last)
        return self._experiment


class Rows(ExperimentWriter):
    """Lightning's writer, but a resumed run keeps the rows up to its step, where Lightning starts an empty file."""

    def __init__(self, folder: str, last: int):
        self.last = last
        super().__init__(folder)

    def _check_log_dir_exists(self) -> None:
        path = Path(self.metrics_file_path)
        if not self.last or not path.is_file():
            path.unlink(missing_ok=True)
            return
        try:
            with path.open(encoding="utf-8", newline="") as file, replacing(path) as beside:
                reader = csv.DictReader(file)
                self.metrics_keys = list(reader.fieldnames)
                with beside.open("w", encoding="utf-8", newline="") as kept:
                    writer = csv.DictWriter(kept, self.metrics_keys)
                    writer.writeheader()
                    writer.writerows(row for row in reader if int(row["step"]) <= self.last)
        except (LookupError, TypeError, ValueError, csv.Error) as error:
            raise CheckpointError(path, f"no readable curves ({type(error).__name__})", "rows with a step") from error

"""edge-se bench processes. Torch-free until it runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from edge_se_sampler.bench.report import write_report
from edge_se_sampler.bench.results import new_result, write_result
from edge_se_sampler.engine.files import make_folder
from edge_se_sampler.errors import check_value
from edge_se_sampler.models.config import MAX_RAYS


@dataclass(frozen=True, kw_only=True)
class BenchProcesses:
    """Time training steps of one process against those of several that share its threads: from how many rays a step
    they pay."""

    output_dir: Path
    """Where result.json and README.md go; a result of an earlier call is replaced."""
    workplace: Path = Path("bench")
    """Where the scene is kept."""
    processes: int = 2
    """That train together, with an equal part of the threads each."""
    rays: tuple[int, ...] = (64, 256, 1024, 4096, 16384)
    """Per step; each number is timed."""
    rounds: int = 7
    """Of some steps each; medians are reported."""

    def run(self) -> None:
        """Measure and report; InputError if a flag's value has no meaning, or a file cannot be written."""
        settings = {key: value for key, value in asdict(self).items() if not isinstance(value, Path)}
        check_value("rounds", self.rounds, self.rounds >= 1, "at least 1")
        valid = all(1 <= count <= MAX_RAYS for count in self.rays or (0,))
        check_value("rays", self.rays, valid, f"numbers between 1 and {MAX_RAYS}")
        make_folder(self.output_dir, "--output-dir")
        from edge_se_sampler.bench.processes.timing import measure

        result = new_result("processes", settings) | {"errors": [], "runs": measure(self.workplace, **settings)}
        write_result(self.output_dir / "result.json", result)
        write_report(self.output_dir)
        print((self.output_dir / "README.md").read_text(encoding="utf-8"))

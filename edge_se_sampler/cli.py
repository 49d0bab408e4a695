"""The command line, `edge-se`: parsing, and how every command ends."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import make_dataclass
from difflib import get_close_matches
from typing import Annotated, Any, NoReturn, Union

import tyro

from edge_se_sampler import ranks
from edge_se_sampler.bench.commands import BENCHES
from edge_se_sampler.commands import COMMANDS
from edge_se_sampler.errors import InputError
from edge_se_sampler.methods import registered_methods
from edge_se_sampler.run_commands import Training


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command; exit code 2 for bad input, 1 for a training that diverged or lost one of its processes, and for an
    experiment of which a training failed, 130 for Ctrl-C."""
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # torch's, before it is imported: large pages for large tensors
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as by >&-
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # help has frames, and paths may be no UTF-8
    try:
        try:
            _run(list(sys.argv[1:] if arguments is None else arguments))
        finally:
            sys.stdout.flush()  # a reader that is gone is noticed here, not when the interpreter ends
    except BrokenPipeError:  # edge-se ... | head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)  # as a shell reports SIGPIPE
    except InputError as problem:
        _exit(str(problem), 2)
    except (FloatingPointError, ConnectionError) as problem:
        _exit(str(problem), 1)
    except OSError as problem:  # of files that are no output: standard output's, the cache of compiled kernels
        if problem.errno not in (errno.ENOSPC, errno.EDQUOT):
            if problem.filename is None:
                raise
            _exit(f"{problem.filename}: cannot be used ({problem.strerror})", 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left there is not tried again
        _exit(f"{problem.filename or 'standard output, or a file'}: cannot be written ({problem.strerror})", 2)
    except (MemoryError, RuntimeError) as problem:
        if not _is_out_of_memory(problem):
            raise
        _exit("there is not enough memory for this; use fewer rays, or a smaller model", 2)
    except KeyboardInterrupt:
        _exit("interrupted", 130)


def _exit(message: str, code: int) -> NoReturn:
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in message)  # names may have line ends in them
    with contextlib.suppress(OSError):  # of a log whose disk is full: the exit code tells, too
        print(f"edge-se: {line}", file=sys.stderr, flush=True)
    if ranks.world_size() > 1:  # torch's threads, waiting for a rank that is gone, may abort a normal end
        os._exit(code)
    sys.exit(code)


def _is_out_of_memory(problem: Exception) -> bool:
    """Whether an allocation failed: torch has a type for that on a GPU, but names its allocator on a CPU."""
    is_of_type = isinstance(problem, MemoryError) or type(problem).__name__ == "OutOfMemoryError"
    return is_of_type or "DefaultCPUAllocator" in str(problem)


def _run(arguments: list[str]) -> None:
    if arguments == ["--version"]:
        from edge_se_sampler import __version__

        print(__version__)
    elif arguments[:1] == ["train"]:
        methods = {name: method.specification for name, method in registered_methods().items()}
        _check_name(arguments[1:], methods, "edge-se train")
        configs = tyro.extras.subcommand_type_from_defaults(
            {name: Training(method.config) for name, method in methods.items()},
            {name: method.description for name, method in methods.items()},
        )
        _parse(_subcommands(COMMANDS | {"train": _nested(configs)}), arguments).chosen.run()
    elif arguments[:1] == ["bench"]:
        _check_name(arguments[1:], BENCHES, "edge-se bench")
        _parse(_subcommands(COMMANDS | {"bench": _nested(_subcommands(BENCHES))}), arguments).chosen.run()
    else:
        _check_name(arguments, COMMANDS, "edge-se")
        _parse(_subcommands(COMMANDS), arguments).run()


def _check_name(arguments: Sequence[str], names: Iterable[str], command: str) -> None:
    """InputError if a command's first argument is neither a flag nor one of the names, of which tyro says too much."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in (names := list(names)):
        meant = get_close_matches(arguments[0], names, 1)
        question = f"did you mean {meant[0]}? " if meant else ""
        raise InputError(f"{command} {arguments[0]}: {question}there are {', '.join(names)}")


def _subcommands(commands: dict[str, type]) -> Any:
    """The type that tyro parses into one of the commands."""
    kinds = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in commands.items())  # type: ignore[valid-type]
    return Union[kinds]  # noqa: UP007


def _nested(kind: Any) -> type:
    """A command that has subcommands, as `chosen`: tyro's hints need the whole command line to name them."""
    return make_dataclass("Nested", [("chosen", Annotated[kind, tyro.conf.arg(name="")])])


def _parse(kind: Any, arguments: list[str]) -> Any:
    return tyro.cli(tyro.conf.configure(tyro.conf.FlagConversionOff)(kind), args=arguments, prog="edge-se")

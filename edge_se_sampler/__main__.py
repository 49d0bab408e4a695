"""The program `edge-se`, and `python -m edge_se_sampler`, which torchrun can start."""

import sys


def main() -> None:
    """Import the command line, which takes its time, and run it: Ctrl-C meanwhile is no traceback either."""
    try:
        from edge_se_sampler.cli import main as run

        run()
    except KeyboardInterrupt:
        print("edge-se: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()

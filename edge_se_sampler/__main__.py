"""`python -m edge_se_sampler`, which torchrun can start: the same as `edge-se`."""

from edge_se_sampler.cli import main

if __name__ == "__main__":
    main()

"""The vanilla NeRF (Mildenhall et al. 2020)."""

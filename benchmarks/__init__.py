"""What measures times: the simulation, the pipeline, sweeps, environments."""

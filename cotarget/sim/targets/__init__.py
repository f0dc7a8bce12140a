"""Simulated targets: a module for each kind, and the table of them; docs/targets-and-scenes.md says how to add one."""

# Names of the kinds. Each is a module of this package whose KIND describes it, and a model in sim_assets/targets. They
# are listed here, so that a configuration can be checked without MuJoCo.
KINDS = (
    "book",
    "person",
    "bird",
)

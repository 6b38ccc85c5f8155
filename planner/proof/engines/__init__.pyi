from planner.proof.engines.section import another_engine as another_engine

ENGINES: tuple[str, ...]

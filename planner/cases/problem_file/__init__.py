"""problem.toml: a machine of one's own as a Problem; see problem_file.build for the format."""

from planner.cases.problem_file.build import NAME, ProblemFile, case_in, load, load_problem, loaded, of_table

__all__ = ["NAME", "ProblemFile", "case_in", "load", "load_problem", "loaded", "of_table"]

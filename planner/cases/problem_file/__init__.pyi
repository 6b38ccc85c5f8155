from planner.cases.problem_file.build import NAME as NAME
from planner.cases.problem_file.build import case_in as case_in
from planner.cases.problem_file.build import load as load
from planner.cases.problem_file.build import load_problem as load_problem
from planner.cases.problem_file.build import loaded as loaded
from planner.cases.problem_file.build import of_table as of_table
from planner.cases.problem_file.solving import ProblemFile as ProblemFile

"""Right plans: machines and motions of many kinds, drawn by a seed, each solved with ordinary settings."""

from corpus import right_arms as right_arms
from corpus import right_machines as right_machines
from corpus import right_replays as right_replays
from corpus.asking import MEMBERS as MEMBERS
from corpus.asking import plan_of as plan_of

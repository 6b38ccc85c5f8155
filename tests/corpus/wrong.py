"""Wrong plans: each has a fault that was planted in its model, its numbers, its file or its making."""

from corpus import wrong_between as wrong_between
from corpus import wrong_contacts as wrong_contacts
from corpus import wrong_models as wrong_models
from corpus import wrong_motions as wrong_motions
from corpus import wrong_numbers as wrong_numbers
from corpus import wrong_optimality as wrong_optimality
from corpus import wrong_replays as wrong_replays
from corpus.planting import MEMBERS as MEMBERS
from corpus.planting import attempt_of as attempt_of

"""The studies, one a file, in the order of the report."""

from experiments.studies import figure_2, figure_3
from experiments.study import Study

STUDIES: tuple[Study, ...] = (figure_2.STUDY, figure_3.STUDY)

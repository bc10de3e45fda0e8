"""The studies, one a file, in the order of the report."""

from experiments.studies import certificates, figure_2, figure_3, hazards, theorems
from experiments.study import Study

STUDIES: tuple[Study, ...] = (
    figure_2.STUDY,
    figure_3.STUDY,
    theorems.STUDY,
    certificates.STUDY,
    hazards.STUDY,
)

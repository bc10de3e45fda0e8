"""The studies, one a file, in the order of the report."""

from experiments.studies import (
    certificates,
    figure_2,
    figure_3,
    figure_4,
    figure_5,
    hazards,
    remark_1,
    stability_map,
    theorems,
)
from experiments.study import Study

STUDIES: tuple[Study, ...] = (
    figure_2.STUDY,
    figure_3.STUDY,
    figure_4.STUDY,
    figure_5.STUDY,
    remark_1.STUDY,
    theorems.STUDY,
    certificates.STUDY,
    hazards.STUDY,
    stability_map.STUDY,
)

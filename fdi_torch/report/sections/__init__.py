"""The sections of the page in order. Each is made from the log, or left out if the log has no content for it."""

from fdi_torch.report.section import Maker
from fdi_torch.report.sections.before_after import holdout_section, profile_section
from fdi_torch.report.sections.blind_benchmark import confusion_section, misses_section, scores_section
from fdi_torch.report.sections.estimate import estimate_section, posterior_section, refinement_section, search_section
from fdi_torch.report.sections.gap import causes_section, disturbances_section, where_section
from fdi_torch.report.sections.gap_closure import (
    closure_section,
    constants_section,
    curves_section,
    errors_section,
    limits_section,
    next_input_section,
)
from fdi_torch.report.sections.intervals import intervals_section
from fdi_torch.report.sections.monitor import event_section, rehearsal_section, residual_section, statistic_section
from fdi_torch.report.sections.origin import (
    configuration_section,
    health_section,
    plain_rig_section,
    provenance_section,
    rig_section,
)
from fdi_torch.report.sections.signals import fit_section, inputs_section
from fdi_torch.report.sections.study import error_section, isolation_section, summary_section, trials_section
from fdi_torch.report.sections.windows import windows_section

SECTIONS: tuple[Maker, ...] = (
    rig_section,
    causes_section,
    where_section,
    closure_section,
    disturbances_section,
    curves_section,
    errors_section,
    holdout_section,
    constants_section,
    profile_section,
    next_input_section,
    limits_section,
    estimate_section,
    windows_section,
    statistic_section,
    event_section,
    residual_section,
    scores_section,
    confusion_section,
    misses_section,
    rehearsal_section,
    summary_section,
    isolation_section,
    error_section,
    trials_section,
    fit_section,
    inputs_section,
    intervals_section,
    posterior_section,
    search_section,
    refinement_section,
    plain_rig_section,
    configuration_section,
    provenance_section,
    health_section,
)

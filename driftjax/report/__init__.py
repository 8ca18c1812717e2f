"""Write figures, tables and the HTML page of a run, from its folder alone."""

from driftjax.report.diagnosis import CLOSED_LOOP as CLOSED_LOOP
from driftjax.report.diagnosis import closed_loop_table as closed_loop_table
from driftjax.report.diagnosis import gain_table as gain_table
from driftjax.report.diagnosis import parity_statement as parity_statement
from driftjax.report.diagnosis_page import write_diagnosis as write_diagnosis
from driftjax.report.error_share import error_share_table as error_share_table
from driftjax.report.film import save_film as save_film
from driftjax.report.inspection import write_inspection as write_inspection
from driftjax.report.learn import write_report as write_report
from driftjax.report.log_comparison import comparison_text as comparison_text
from driftjax.report.log_comparison import write_comparison as write_comparison
from driftjax.report.plan import save_plan as save_plan
from driftjax.report.plan import write_plan_figures as write_plan_figures
from driftjax.report.table import results_table as results_table
from driftjax.report.table import run_line as run_line
from driftjax.report.tuning import tuning_summary as tuning_summary
from driftjax.report.tuning import write_tuning as write_tuning
from driftjax.report.write import write_page as write_page

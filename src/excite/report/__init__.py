"""From records to tables and figures that people read.

Everything comes in as plain data (records, descriptions, JSON-ready dictionaries): no
line of this room computes an experiment.
"""

from .figure import PLOT_ENDINGS as PLOT_ENDINGS
from .figure import image as image
from .figure import kept_samples as kept_samples
from .figure import require_plot_path as require_plot_path
from .figure import save as save
from .figures import autocorrelation_figure as autocorrelation_figure
from .figures import benchmark_figure as benchmark_figure
from .figures import correlation_figure as correlation_figure
from .figures import episode_figure as episode_figure
from .figures import episodes_figure as episodes_figure
from .figures import identification_figure as identification_figure
from .figures import information_figure as information_figure
from .frontier import frontier_figure as frontier_figure
from .frontier import lengths_figure as lengths_figure
from .html import report_html as report_html
from .numbers import digits_for as digits_for
from .numbers import number as number
from .study_figures import agents_figure as agents_figure
from .study_figures import curves_figure as curves_figure
from .tables import all_cells as all_cells
from .tables import benchmark_csv as benchmark_csv
from .tables import benchmark_latex as benchmark_latex
from .tables import benchmark_markdown as benchmark_markdown
from .tables import differences_cells as differences_cells
from .tables import differences_csv as differences_csv
from .tables import differences_markdown as differences_markdown
from .tables import fitting_tables as fitting_tables
from .tables import footnotes as footnotes
from .tables import largest_correlation as largest_correlation
from .tables import parameter_cells as parameter_cells
from .tables import parameter_header as parameter_header
from .tables import reference_cells as reference_cells
from .tables import residual_cells as residual_cells
from .tables import residual_in_words as residual_in_words
from .tables import table_cells as table_cells
from .tables import table_header as table_header

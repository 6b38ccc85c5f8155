"""The paper's own methods, run on its own problems: results as JSON values, Markdown, rows of the table, and plots.

One file per claim: masses (2.1: effort 73.6 to 9.9), elbow_gradient (2.2: the gradient near convergence),
hopper_splines (2.4: B-splines that did not converge), shooting_sensitivity (2.1: the shooting method that failed).
"""

"""Monte Carlo campaign: random masses and initial states, and the quantiles of the errors."""

import fflin

robot = fflin.load("servicer_7dof", lock=["panel_*"])
lin = fflin.linearize(robot)
policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
uncertain = {"q_b": 0.05, "q_m": (-0.1, 0.1), "*.density": 0.05}
campaign = fflin.monte_carlo(robot, policy, uncertain, runs=60, duration=60.0, dt=0.1)
print(campaign.fraction("attitude < 1 deg"))
fflin.plot_campaign(campaign).savefig("monte_carlo.png", dpi=62)

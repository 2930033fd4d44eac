"""The paper's own numbers, beside which ours stand (sec. 5 and 6)."""

ERRORS = {"vision": (49.83, 59.65, 22.56, 39.61), "mse": (7.62, 6.49, 2.51, 3.37), "likelihood": (6.83, 5.92, 2.46, 3.39),
          "ours": (4.42, 3.84, 2.10, 2.96)}  # tab. estimator_ablation: mean L2, RMSE (mm), mean abs., RMSE (deg)
SUCCESS = {"est_uncertainty": 94, "est": 92, "est_mse": 64, "priv_on_estimate": 83, "end_to_end": 12,
           "behavior_cloning": 38}  # %
LOSS = {"est_uncertainty": 6.7, "est": 8.3, "end_to_end": 45.8, "behavior_cloning": 37.6}  # points, none to full occlusion
SWITCHES = {"priv_on_state": "2.68 +- 1.53", "est_uncertainty": "4.22 +- 2.67"}  # mean +- std
ROBOT = {"natural": "19/20", "hand_5s": "10/10", "hand_full": "7/10"}

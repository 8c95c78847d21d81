"""A complete batch, as a pipeline would send it."""

BATCH = {
    "spacecraft": "XTE",
    "batch": "1996-010-0001",
    "time": "1996-01-10T12:00:00.000Z",
    "a_priori": {"quaternion": [0.1, 0.2, 0.3, 0.9273618495495703], "frame": "EME2000"},
    "body_rates_deg_per_s": [0.0, 0.0, 0.0],
    "velocity_km_per_s": [0.0, 7.5, 0.0],
    "aberration": "to_correct",
    "observations": [
        {
            "tracker": "STARTRACKER_1",
            "stars": [
                {"vector": [0.0123, -0.0157, 0.9998], "magnitude": 5.31, "time_offset_s": 0.0},
                {"h_deg": 0.52, "v_deg": -1.21, "magnitude": 4.02, "sigma_arcsec": 3.0},
            ],
        }
    ],
}

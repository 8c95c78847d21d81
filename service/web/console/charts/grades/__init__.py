"""Charts of filtered and smoothed attitudes: traces by grade, innovations, time line."""

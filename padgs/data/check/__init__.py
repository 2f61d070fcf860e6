"""Is a data set fit for training, and if not, why?"""

-- Results that the coordinator has not found in their store are counted whenever somebody looks at a job.
CREATE INDEX output_unchecked ON output (result_set, task) WHERE NOT checked;

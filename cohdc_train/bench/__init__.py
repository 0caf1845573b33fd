"""Comparisons with the paper: networks (Table 4), SLAM (Tables 5 to 7), training (Table 3)."""

from cohdc_train.bench.networks import bench_networks
from cohdc_train.bench.table3 import bench_table3
from cohdc_train.bench.tum import bench_tum

COMMANDS = {"networks": bench_networks, "tum": bench_tum, "table3": bench_table3}

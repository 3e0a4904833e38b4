"""The cells of a study from the blocks of replications that its tasks did."""

from __future__ import annotations

from typing import TYPE_CHECKING

from doe.studies.monte_carlo.specification import CELL, RANDOM

if TYPE_CHECKING:
    import polars


def pooled(blocks: polars.DataFrame) -> polars.DataFrame:
    """One row per cell and parameter: blocks pooled.

    `fits`, `failed` : numbers of data sets;  `mean_error`, `std`, `rms` : of the errors, file units
    `mean_error_se`, `std_se` : their standard errors; the deviation's for normal errors, so null for random plans
    `expected_std` : eq. 16; of random plans the root mean square over the plans, which `std` must equal
    `coverage` : fraction of 95 % intervals, with the true sigma and each data set's own plan, that hold the true value
    `rms_mm` : of the fits' residuals per row;  `status`, `error` : of the first block that failed, else done
    """
    import polars as pl

    columns = {"parameter": pl.String, "unit": pl.String, "fits": pl.Int64, "failed": pl.Int64, "covered": pl.Int64}
    columns |= dict.fromkeys(("mean_error", "squares", "expected_std", "rms_mm"), pl.Float64)
    for name, dtype in columns.items():
        column = pl.col(name).cast(dtype) if name in blocks.columns else pl.lit(None, dtype)
        blocks = blocks.with_columns(column.alias(name))
    n = pl.col("fits").sum()
    mean = (pl.col("mean_error") * pl.col("fits")).sum() / n
    about = pl.col("squares").sum() + (pl.col("fits") * (pl.col("mean_error") - mean) ** 2).sum()
    std = (about / (n - 1)).sqrt()
    expected = ((pl.col("expected_std") ** 2 * pl.col("fits")).sum() / n).sqrt()
    some = pl.col("status") == "done"
    return blocks.group_by(*CELL, "inputs", "parameter", "unit", maintain_order=True).agg(
        n.alias("fits"),
        pl.col("failed").sum(),
        pl.when(n > 0).then(mean).alias("mean_error"),
        pl.when(n > 1).then(std).alias("std"),
        pl.when(n > 0).then((about / n + mean**2).sqrt()).alias("rms"),
        pl.when(n > 1).then(std / n.sqrt()).alias("mean_error_se"),
        pl.when((n > 1) & (pl.col("plan").first() != RANDOM)).then(std / (2.0 * (n - 1)).sqrt()).alias("std_se"),
        pl.when(n > 0).then(expected).alias("expected_std"),
        pl.when(n > 0).then(pl.col("covered").sum() / n).alias("coverage"),
        pl.when(n > 0).then(((pl.col("rms_mm") ** 2 * pl.col("fits")).sum() / n).sqrt()).alias("rms_mm"),
        pl.when(some.all()).then(pl.lit("done")).otherwise(pl.lit("failed")).alias("status"),
        pl.col("error").cast(pl.String).drop_nulls().first().alias("error"),
    )


/* Memory z. One row per entry of z; A: one column per entry of z, B: one column per state. */
static const ${name}_real A[${NAME}_MEMORY_MAX][${NAME}_MEMORY_MAX] = $A;
static const ${name}_real B[${NAME}_MEMORY_MAX][${NAME}_STATES] = $B;

/* One row per input, one column per entry of z. */
static const ${name}_real C[${NAME}_INPUTS][${NAME}_MEMORY_MAX] = $C;

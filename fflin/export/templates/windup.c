
/* Anti-windup. One row per entry of z, one column per input: E times the change of the inputs by
 * the limits is added to the next z.
 */
static const ${name}_real E$tables[${NAME}_MEMORY_MAX][${NAME}_INPUTS] = $E;

/* Add gain times the change of u by its limits to next. */
static void limit_windup(const ${name}_real gain[${NAME}_MEMORY_MAX][${NAME}_INPUTS],
                         const ${name}_real u[${NAME}_INPUTS],
                         ${name}_real next[${NAME}_MEMORY_MAX])
{
    ${name}_real change[${NAME}_INPUTS];
    int i, j;

    for (j = 0; j < ${NAME}_INPUTS; j++) {
        change[j] = u[j] < low[j] ? low[j] - u[j] : (u[j] > high[j] ? high[j] - u[j] : 0);
    }
    for (i = 0; i < ${NAME}_MEMORY; i++) {
        for (j = 0; j < ${NAME}_INPUTS; j++) {
            next[i] += gain[i][j] * change[j];
        }
    }
}

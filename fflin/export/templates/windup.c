
/* Anti-windup. One row per entry of z, one column per input: E times the change of the inputs by
 * the limits is added to the next z.
 */
static const ${name}_real E$tables[${NAME}_MEMORY_MAX][${NAME}_INPUTS] = $E;

/* Return the change of the input u[i] by its limits. */
static ${name}_real cut(${name}_real value, int i)
{
    return value < low[i] ? low[i] - value : (value > high[i] ? high[i] - value : 0);
}

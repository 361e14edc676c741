#define ${NAME}_MEMORY $memory
#define ${NAME}_MEMORY_MAX $memory

/* Memory of the law, such as its integrals; the caller owns it. */
typedef struct {
    ${name}_real z[${NAME}_MEMORY_MAX];
} ${name}_memory;

/* Set the memory to its value at the start. */
void ${name}_start(${name}_memory *memory);

